"""What is run on a measurement, and how well forecasts do."""
