"""One file per format that recordings are exported to."""
