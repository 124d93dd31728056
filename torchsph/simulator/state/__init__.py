"""What a run carries."""
