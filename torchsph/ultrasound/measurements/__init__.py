"""Whole measurements of a known flow: scan, estimate, calibrate, or add noise by a model."""
