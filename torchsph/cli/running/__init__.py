"""What surrounds a run: its settings, notes, signals, status, the lock of its folder, where its results come from."""
