"""What `export` notes in its files, and how `convert` takes them back by it."""
