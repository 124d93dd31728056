"""Recordings: the class, the rules of the file, reading and writing."""
