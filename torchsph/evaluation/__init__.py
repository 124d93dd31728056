"""Scores and pictures of recordings; knows geometry alone."""
