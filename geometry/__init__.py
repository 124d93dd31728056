"""Recordings, regular grids, closed surfaces and their signed distance, moving walls, ventricle shapes."""

from .closest import Closest, SurfaceIndex
from .distance import GridDistance, distance_and_closest, signed_distance
from .grid import Grid, Stencil
from .motion import WallMotion
from .moving_distance import MovingDistance, WallField, WallPoint
from .recording import Recording, Wall
from .recording_read import read_recording
from .recording_rules import RecordingError
from .recording_write import write_recording
from .shapes import box, ellipse, ellipsoid, polygon, revolved, tube
from .surface import Surface, SurfaceError
from .ventricle import Beat, Ventricle
from .winding import grid_winding, winding_number

__all__ = [
    "Beat",
    "Closest",
    "Grid",
    "GridDistance",
    "MovingDistance",
    "Recording",
    "RecordingError",
    "Stencil",
    "Surface",
    "SurfaceError",
    "SurfaceIndex",
    "Ventricle",
    "Wall",
    "WallField",
    "WallMotion",
    "WallPoint",
    "box",
    "distance_and_closest",
    "ellipse",
    "ellipsoid",
    "grid_winding",
    "polygon",
    "read_recording",
    "revolved",
    "signed_distance",
    "tube",
    "winding_number",
    "write_recording",
]
