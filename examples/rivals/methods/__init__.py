"""One rival a file: `fit(recording, **settings) -> velocity (T, 3, *shape)`, m/s."""
