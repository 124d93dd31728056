"""What particles see of walls."""
