"""Walls and valves of a recording as the spline smoother's rows."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

import geometry
from regularize import WallRows

POINTS_PER_KNOT = 4  # on the wall, along a knot distance
MANY = 4  # times as many faces as such points are worth replacing
FEWEST = 1000  # points below which it saves nothing
# openings of one label that face apart cancel: below this part of their area, they pass no plug together
FACING = 0.4


def open_regions(recording: geometry.Recording, time: float) -> tuple[int, ...]:
    """Regions of the orifices that are open at ``time`` (s), or leak, in ascending order."""
    rows = recording.valve_intervals_or_derived()
    passing = {int(r) for r, opens, closes in rows if opens <= time < closes}
    if recording.valve_leak is not None:
        passing |= {int(r) for r, part in recording.valve_leak if part > 0}
    present = np.unique(recording.wall_for("open orifices").region).tolist()
    return tuple(sorted(passing & set(present)))


def open_together(
    recording: geometry.Recording, motion: geometry.WallMotion, frame: int, contradicted: bool
) -> tuple[int, ...]:
    """Regions at a frame whose fluxes are for the data to say: several, or velocities contradict the walls.

    Openings that face apart are several, also where they share a label.
    """
    time = float(recording.time[frame])
    regions = open_regions(recording, time)
    if len(regions) == 1 and not contradicted:
        return () if faces_one_way(motion.surface(time), regions[0]) else regions
    return regions


def faces_one_way(surface: geometry.Surface, region: int) -> bool:
    """Whether a region's faces look in about one direction, so that one plug can pass them.

    Two openings at opposite ends that share a label do not: their area vectors cancel.
    """
    part = surface.part(region)
    vector = surface.area_vectors[part].sum(0)
    return float(np.linalg.norm(vector)) >= FACING * float(surface.areas[part].sum())


def at_knots(motion: geometry.WallMotion, knots: float) -> tuple[geometry.WallMotion, geometry.WallSampler | None]:
    """The wall with as many points as knots of a distance ``knots`` (m) can tell apart.

    The midpoint rule over the faces is exact in the flux and good enough while no edge is longer than the knots, so
    that coarser faces are cut. Where there are several times more faces than points a quarter of the knots apart, such
    points stand for them: rows cost time, and a scan may have hundreds of thousands of faces.
    """
    surface = motion.surface(float(motion.time[0]))
    corner = surface.vertices[surface.faces]
    longest = float(np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max())
    if longest > knots:
        return geometry.refined_motion(motion, knots), None
    step = knots / POINTS_PER_KNOT
    if len(surface.faces) > MANY * max(surface.area / step ** (surface.dimension - 1), FEWEST):
        return motion, geometry.WallSampler(motion, step)
    return motion, None


def wall_rows(
    recording: geometry.Recording,
    motion: geometry.WallMotion,
    frame: int,
    *,
    at_rest: bool = False,
    sampler: geometry.WallSampler | None = None,
    knots: float = 0.0,
    free: bool = False,
) -> WallRows:
    """One row per wall point at a frame, weighted by area.

    A wall that stands sigma from where it is said to stand (``/wall/sigma``) tells of the flow there what a spline
    changes by over sigma, so that its rows weigh 1 / (1 + (sigma / knots)^2) times as much beside the others; what that
    makes of all of them is ``mean_certainty``.

    An orifice that alone is open carries the flux dV/dt as a plug. Where several are open, or one label names openings
    that face apart, how they share it is for the data to say: they have no rows, and that their fluxes sum to dV/dt is
    an equation of its own (``flux_data``).

    Args:
        recording: whose frame and valves it is.
        motion: of its wall.
        frame: its number.
        at_rest: every velocity zero, the rows of an increment between two fields that both obey the walls.
        sampler: points on the wall; None: one in the middle of each face, with its exact area and normal.
        knots: m, knot distance of the splines, which an uncertain wall is held against.
        free: leave a single open orifice to the data as well.
    """
    time = float(recording.time[frame])
    surface = motion.surface(time)
    if sampler is None:
        speed = motion.velocity(time)[surface.faces].mean(1)
        points = geometry.WallPoints(surface.centroids, surface.normals, speed, surface.areas, surface.region)
    else:
        points = sampler.at(time)
    velocity, regions = points.velocities, open_regions(recording, time)
    plug = len(regions) == 1 and not free and faces_one_way(surface, regions[0])
    if plug:
        vector = surface.area_vectors[surface.part(regions[0])].sum(0)
        area = float(np.linalg.norm(vector))
        velocity[points.region == regions[0]] += -motion.volume_rate(time) / area * vector / area
    no_slip = ~np.isin(points.region, regions)
    good = (points.areas > 0) & (no_slip | plug)

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values[good]))

    if at_rest:
        velocity = np.zeros_like(velocity)
    weight = points.areas * _certainty(recording, frame, points.points, knots)
    return WallRows(tensor(points.points), tensor(points.normals), tensor(velocity), tensor(weight), tensor(no_slip))


def _certainty(recording: geometry.Recording, frame: int, points: np.ndarray, knots: float) -> np.ndarray | float:
    """Factor (n,) on the rows at points (n, D): 1 where the wall is certain."""
    wall = recording.wall_for("wall rows")
    if wall.sigma is None or knots <= 0:
        return 1.0
    sigma = wall.sigma if wall.sigma.ndim == 1 else wall.sigma[frame]
    # points may stand between the recording's own vertices: the nearest one's deviation is theirs
    nearest = cKDTree(wall.at(frame).vertices).query(points)[1]
    return 1.0 / (1.0 + (sigma[nearest].astype(np.float64) / knots) ** 2)


def mean_certainty(recording: geometry.Recording, frame: int, knots: float) -> float:
    """Mean factor on the rows of a frame's walls: 1 where ``/wall/sigma`` is not given."""
    surface = recording.wall_for("wall rows").at(frame)
    each = _certainty(recording, frame, surface.centroids, knots)
    return each if isinstance(each, float) else float((each * surface.areas).sum() / surface.areas.sum())
