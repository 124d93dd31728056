"""What a measurement says of a field, and how far it is to be believed."""
