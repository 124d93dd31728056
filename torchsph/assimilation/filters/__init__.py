"""Ensemble filters and what they are made of."""
