"""A parametric ventricle: its beat and its mesh."""
