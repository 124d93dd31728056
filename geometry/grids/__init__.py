"""Regular grids and the fields on them."""
