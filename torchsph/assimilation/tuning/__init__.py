"""What a filter learns on the way."""
