"""Compiled code: its sources, how it is built and loaded; serves pairs, walls and ultrasound alike."""
