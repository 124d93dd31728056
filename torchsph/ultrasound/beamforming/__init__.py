"""From the signals of an array's elements to IQ images: demodulation, then delay-and-sum."""
