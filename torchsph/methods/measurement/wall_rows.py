"""Walls and valves of a recording as the spline smoother's rows."""

from __future__ import annotations

import numpy as np
import torch

import geometry
from regularize import WallRows


def open_regions(recording: geometry.Recording, time: float) -> tuple[int, ...]:
    """Regions of the orifices that are open at ``time`` (s), in ascending order."""
    rows = recording.valve_intervals_or_derived()
    present = set(np.unique(recording.wall.region).tolist())
    return tuple(sorted({int(r) for r, opens, closes in rows if opens <= time < closes and int(r) in present}))


def flux_shares(regions: tuple[int, ...], volume_rate: float) -> dict[int, float]:
    """How dV/dt (m^3/s) is shared by the open orifices: filling through the first, emptying through the last."""
    shares = dict.fromkeys(regions, 0.0)
    if regions:
        shares[regions[0] if volume_rate > 0 else regions[-1]] = volume_rate
    return shares


def wall_rows(
    recording: geometry.Recording, motion: geometry.WallMotion, frame: int, *, at_rest: bool = False
) -> WallRows:
    """One row per wall face at a frame, weighted by area; an open orifice carries the flux dV/dt as a plug.

    The rows are the midpoint rule over the faces: enough, and exact in the flux, while faces are smaller than the
    knots. A coarser surface is refined first (``geometry.refined_motion``); points gathered evenly over a finer one
    (``geometry.WallSampler``) would save rows, which cost next to nothing, and lose the faces' exact areas and normals.

    ``at_rest``: every velocity zero, the rows of an increment between two fields that both obey the walls.
    """
    time = float(recording.time[frame])
    surface = motion.surface(time)
    velocity = motion.velocity(time)[surface.faces].mean(1)
    regions = open_regions(recording, time)
    for region, flux in flux_shares(regions, motion.volume_rate(time)).items():
        faces = surface.part(region)
        vector = surface.area_vectors[faces].sum(0)
        area = float(np.linalg.norm(vector))
        velocity[faces] += -flux / area * vector / area
    no_slip = ~np.isin(surface.region, regions)
    good = surface.areas > 0

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values[good]))

    if at_rest:
        velocity = np.zeros_like(velocity)
    return WallRows(
        tensor(surface.centroids), tensor(surface.normals), tensor(velocity), tensor(surface.areas), tensor(no_slip)
    )
