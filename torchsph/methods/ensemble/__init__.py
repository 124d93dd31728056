"""The cycle of the ensemble: forecast, observe, analyse, learn."""
