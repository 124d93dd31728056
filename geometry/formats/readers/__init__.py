"""One file per format: each tells what a file holds, as a `Source`, and leaves the meaning to the field map."""
