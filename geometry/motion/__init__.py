"""Walls that move, and what is found on them: points, orifices, moving distance."""
