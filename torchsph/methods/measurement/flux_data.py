"""What a frame's spline should pass through the openings: measured fluxes, and their sum where several are open.

Openings that are open together leave the profile and the split of their flow to the data; that they pass dV/dt
together is known (continuity), as well as the walls' motion is. A flux that was measured (``/flux/region_N``) counts by
its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

import geometry
from regularize import LinearData, SplineField

# a flux is held against a spline that is known over at least this part of the opening; the rest is taken to be like it
_LEAST_COVERAGE = 0.5
# m/s over the opening: nobody knows a flux better, and equations that repeat each other stay solvable
_FINEST = 1e-5


class _Flux(NamedTuple):
    """An equation: the sum over points (n, D) of rows (n, D), m^2, times velocities is ``value``, within ``sigma``."""

    points: np.ndarray
    rows: np.ndarray
    value: float
    sigma: float


def flux_data(
    recording: geometry.Recording,
    motion: geometry.WallMotion,
    frame: int,
    field: SplineField,
    open_together: Sequence[int] = (),
    rate_sigma: float = 0.0,
) -> LinearData | None:
    """Equations for the fluxes at a frame; None where there are none.

    Args:
        recording: whose measured fluxes count.
        motion: of its wall.
        frame: its number.
        field: the spline, which is asked where it is known.
        open_together: regions whose fluxes sum to dV/dt; (): that is no equation.
        rate_sigma: m^3/s, standard deviation of dV/dt.
    """
    time = float(recording.time[frame])
    openings = {label: _opening(motion, time, (label,), field) for label in {flux.region for flux in recording.fluxes}}
    equations = []
    for flux in recording.fluxes:
        opening = openings[flux.region]
        if opening is not None:
            value = opening.value + float(flux.value[frame])
            equations.append(opening._replace(value=value, sigma=max(opening.sigma, float(flux.deviation[frame]))))
    whole = _opening(motion, time, open_together, field) if open_together else None
    if whole is not None:
        value = whole.value + motion.volume_rate(time)
        equations.append(whole._replace(value=value, sigma=max(whole.sigma, rate_sigma)))
    if not equations:
        return None
    sizes = torch.tensor([len(one.points) for one in equations])
    return LinearData(
        points=torch.from_numpy(np.concatenate([one.points for one in equations])),
        rows=torch.from_numpy(np.concatenate([one.rows for one in equations])),
        group=torch.repeat_interleave(torch.arange(len(equations)), sizes),
        value=torch.tensor([one.value for one in equations], dtype=torch.float64),
        sigma=torch.tensor([one.sigma for one in equations], dtype=torch.float64),
    )


def _opening(motion: geometry.WallMotion, time: float, labels: Sequence[int], field: SplineField) -> _Flux | None:
    """The equation that nothing passes the openings of some regions; None where the spline is not known there."""
    surface = motion.surface(time)
    faces = np.flatnonzero(np.isin(surface.region, labels))
    if len(faces) == 0:
        return None
    points, rows, areas = surface.centroids[faces], -surface.area_vectors[faces], surface.areas[faces]
    moving = float((rows * motion.velocity(time)[surface.faces[faces]].mean(1)).sum())
    known = field.supported(torch.from_numpy(points)).numpy()
    part = areas[known].sum() / areas.sum()
    if part < _LEAST_COVERAGE:
        return None
    return _Flux(points[known], rows[known] / part, moving, _FINEST * float(areas.sum()))
