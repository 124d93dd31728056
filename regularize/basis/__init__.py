"""B-splines on knot grids."""
