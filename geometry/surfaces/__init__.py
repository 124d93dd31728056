"""Closed surfaces: shapes, files, repair, segmentation, distance."""
