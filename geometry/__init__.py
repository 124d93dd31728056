"""Recordings, regular grids, closed surfaces and their signed distance, moving walls, ventricle shapes."""

from .grids.grid import Grid, Stencil
from .grids.unwrapping import unwrap
from .motion.beats import Repetition, repetition, split_beats, told_apart
from .motion.estimates import Estimates, estimated
from .motion.moving_distance import MovingDistance, WallField, WallPoint
from .motion.orifices import Orifice, OrificePlane, orifices
from .motion.plane_cut import plane_cut
from .motion.planes_in_space import PlacedPlane, planes_in_space
from .motion.refine import refined, refined_motion
from .motion.valve_times import ValveTimes, find_valve_times
from .motion.wall_estimate import WallEstimate, estimate_wall
from .motion.wall_motion import WallMotion
from .motion.wall_points import WallPoints, WallSampler, wall_points
from .recordings.checks import findings
from .recordings.errors import RecordingError
from .recordings.finding import Finding
from .recordings.measurement_types import MeasurementType, measurement_type
from .recordings.opening_flux import OpeningFlux
from .recordings.quality import Quality
from .recordings.read import read_provenance, read_recording
from .recordings.recording import Recording, Wall
from .recordings.rules import check_recording
from .recordings.write import write_recording
from .surfaces.closest import Closest, SurfaceIndex
from .surfaces.distance import GridDistance, distance_and_closest, signed_distance
from .surfaces.files import labelled, read_surface, write_surface
from .surfaces.openings import Opening, openings, with_lids
from .surfaces.repair import repaired
from .surfaces.segmentation import surface_from_mask, surface_from_points, surface_from_velocity, taubin
from .surfaces.shapes import box, ellipse, ellipsoid, polygon, revolved, tube
from .surfaces.surface import Surface, SurfaceError
from .surfaces.winding import grid_winding, winding_number
from .ventricle.ventricle import Beat, Ventricle

__all__ = [
    "Beat",
    "Closest",
    "Estimates",
    "Finding",
    "Grid",
    "GridDistance",
    "MeasurementType",
    "MovingDistance",
    "Opening",
    "OpeningFlux",
    "Orifice",
    "OrificePlane",
    "PlacedPlane",
    "Quality",
    "Recording",
    "RecordingError",
    "Repetition",
    "Stencil",
    "Surface",
    "SurfaceError",
    "SurfaceIndex",
    "ValveTimes",
    "Ventricle",
    "Wall",
    "WallEstimate",
    "WallField",
    "WallMotion",
    "WallPoint",
    "WallPoints",
    "WallSampler",
    "box",
    "check_recording",
    "distance_and_closest",
    "ellipse",
    "ellipsoid",
    "estimate_wall",
    "estimated",
    "find_valve_times",
    "findings",
    "grid_winding",
    "labelled",
    "measurement_type",
    "openings",
    "orifices",
    "plane_cut",
    "planes_in_space",
    "polygon",
    "read_provenance",
    "read_recording",
    "read_surface",
    "refined",
    "refined_motion",
    "repaired",
    "repetition",
    "revolved",
    "signed_distance",
    "split_beats",
    "surface_from_mask",
    "surface_from_points",
    "surface_from_velocity",
    "taubin",
    "told_apart",
    "tube",
    "unwrap",
    "wall_points",
    "winding_number",
    "with_lids",
    "write_recording",
    "write_surface",
]
