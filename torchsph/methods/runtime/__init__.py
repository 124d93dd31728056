"""Processes and restarts."""
