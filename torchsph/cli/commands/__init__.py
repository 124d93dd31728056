"""The commands, a file each; the program lists them."""
