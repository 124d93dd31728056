"""The smoother: options, samples, rows, the search for smoothness, fits over time."""
