"""Synthetic problems with published scores."""
