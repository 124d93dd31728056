"""Recordings, regular grids, closed surfaces and their signed distance, moving walls, ventricle shapes."""

from .grid import Grid, Stencil
from .recording import Recording, Wall
from .recording_read import read_recording
from .recording_rules import RecordingError
from .recording_write import write_recording
from .surface import Surface, SurfaceError
from .winding import grid_winding, winding_number

__all__ = [
    "Grid",
    "Recording",
    "RecordingError",
    "Stencil",
    "Surface",
    "SurfaceError",
    "Wall",
    "grid_winding",
    "read_recording",
    "winding_number",
    "write_recording",
]
