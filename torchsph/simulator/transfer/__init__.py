"""Velocities between grids and particles."""
