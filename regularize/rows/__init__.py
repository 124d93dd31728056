"""Linear rows of the spline system and their numbering."""
