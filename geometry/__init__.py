"""Recordings, regular grids, closed surfaces and their signed distance, moving walls, ventricle shapes."""

from .closest import Closest, SurfaceIndex
from .distance import GridDistance, distance_and_closest, signed_distance
from .grid import Grid, Stencil
from .motion import WallMotion
from .moving_distance import MovingDistance, WallField, WallPoint
from .orifices import Orifice, OrificePlane, orifices
from .recording import Recording, Wall
from .recording_read import read_recording
from .recording_rules import RecordingError
from .recording_write import write_recording
from .refine import refined, refined_motion
from .repair import repaired
from .segmentation import surface_from_mask, surface_from_points, surface_from_velocity, taubin
from .shapes import box, ellipse, ellipsoid, polygon, revolved, tube
from .surface import Surface, SurfaceError
from .surface_files import labelled, read_surface, write_surface
from .ventricle import Beat, Ventricle
from .wall_points import WallPoints, WallSampler, wall_points
from .winding import grid_winding, winding_number

__all__ = [
    "Beat",
    "Closest",
    "Grid",
    "GridDistance",
    "MovingDistance",
    "Orifice",
    "OrificePlane",
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
    "WallPoints",
    "WallSampler",
    "box",
    "distance_and_closest",
    "ellipse",
    "ellipsoid",
    "grid_winding",
    "labelled",
    "orifices",
    "polygon",
    "read_recording",
    "read_surface",
    "refined",
    "refined_motion",
    "repaired",
    "revolved",
    "signed_distance",
    "surface_from_mask",
    "surface_from_points",
    "surface_from_velocity",
    "taubin",
    "tube",
    "wall_points",
    "winding_number",
    "write_recording",
    "write_surface",
]
