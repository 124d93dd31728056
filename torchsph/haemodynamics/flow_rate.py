"""Flow rates through openings and planes, and what clinics read off their curves.

| quantity | formula | unit |
|---|---|---|
| `OpeningFlow.rate` | Q = -integral of (u - w) . n dA over an orifice, w its velocity, n out of the blood | m^3/s |
| `plane_flow` | integral of u . n dA over the blood in a plane | m^3/s |
| `stroke_volume` | time integral of the flow that leaves through the outlet, less what returns | m^3 |
| `regurgitant_volume` | time integral of the flow against the valve's own direction | m^3 |
| `regurgitant_fraction` | regurgitant volume over the volume that went the right way | 1 |
| `e_and_a` | the first and the last peak of the filling curve, their ratio and times | m^3/s, s |

(Definitions: Lancellotti et al. 2013, EACVI recommendations on native valvular regurgitation; Nagueh et al. 2016 for E
and A.) At an orifice the velocity is that of a quadratic fitted to the nodes of the mask around: extrapolated by up to
a spacing, as no node lies on the orifice itself. The wall does not enter: a jet has its speed right up to the rim, and
a parabola that knows of the still rim takes a tenth of it away (true velocities of the phantom at 1 mm: 8 % too little
at the inlet, 13 % at the outlet; with the wall's points as samples 8 and 34 %).

While one valve alone is open its flow is dV/dt of the walls, which is exact (`geometry.WallMotion.volume_rate`): what
the velocities say beside it is a check of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

import geometry

from .fields.polynomial_fit import derivative_coefficients
from .fields.sampling import PlaneSection

__all__ = [
    "FillingPeaks",
    "OpeningFlow",
    "e_and_a",
    "peaks",
    "plane_flow",
    "regurgitant_fraction",
    "regurgitant_volume",
    "stroke_volume",
]

Array = NDArray[np.float64]

LEAST_PEAK = 0.1
"""A peak lower than this share of the highest one is noise, not a wave."""


class OpeningFlow:
    """The flow rate through one orifice in one frame, for any number of velocities.

    Args:
        grid: the nodes.
        mask: bool `(*shape)`.
        wall: points of the wall at that time, orifices included (`geometry.WallSampler.at`).
        region: label of the orifice.

    Raises:
        ValueError: the wall has no such region.
    """

    def __init__(self, grid: geometry.Grid, mask: ArrayLike, wall: geometry.WallPoints, region: int) -> None:
        chosen = wall.region == region
        if not chosen.any():
            raise ValueError(f"OpeningFlow: the wall has no region {region}, only {np.unique(wall.region).tolist()}")
        self.grid = grid
        self.nodes = np.flatnonzero(np.asarray(mask, bool))
        samples = grid.nodes().numpy()[self.nodes]
        fit = derivative_coefficients(wall.points[chosen], samples, np.asarray(grid.spacing))
        vectors = wall.normals[chosen] * wall.areas[chosen, None]
        # -sum over points of A n . (sum of coefficients * samples): one weight for each node and component
        weights = np.zeros((len(samples), grid.dimension))
        there = fit.number >= 0
        for axis in range(grid.dimension):
            parts = fit.value * vectors[:, axis, None]
            weights[:, axis] = -np.bincount(fit.number[there], weights=parts[there], minlength=len(samples))
        self._weights = weights
        self._swept = float((vectors * wall.velocities[chosen]).sum())

    def rate(self, velocity: ArrayLike) -> Array:
        """Flow into the blood `(*batch)`, m^3/s, of `velocity` `(*batch, D, *shape)`, m/s."""
        array = np.asarray(velocity)
        lead = array.shape[: array.ndim - 1 - self.grid.dimension]
        values = array.reshape(*lead, self.grid.dimension, -1)[..., self.nodes].astype(np.float64)
        return np.einsum("...dn,nd->...", values, self._weights) + self._swept


def plane_flow(velocity: ArrayLike, grid: geometry.Grid, mask: ArrayLike, section: PlaneSection) -> Array:
    """Flow along the normal of a plane `(*batch)`, m^3/s, of `velocity` `(*batch, 3, *shape)`, m/s."""
    sampled = section.sample(grid, velocity, mask)
    return np.einsum("...dts,d->...", sampled, section.normal) * section.pixel_area


def stroke_volume(time: ArrayLike, outflow: ArrayLike) -> Array:
    """Volume that leaves through an outlet `(*batch)`, m^3: the time integral of all of its flow.

    Args:
        time: `(T,)`, s.
        outflow: `(*batch, T)`, m^3/s, positive outwards.
    """
    return _integral(time, outflow)


def regurgitant_volume(time: ArrayLike, flow: ArrayLike) -> Array:
    """Volume that passes a valve against its direction `(*batch)`, m^3.

    Args:
        time: `(T,)`, s.
        flow: `(*batch, T)`, m^3/s, positive in the valve's own direction.
    """
    return _integral(time, np.maximum(-np.asarray(flow, np.float64), 0.0))


def regurgitant_fraction(time: ArrayLike, flow: ArrayLike) -> Array:
    """Regurgitant volume over the volume that passed the valve the right way `(*batch)`; 0 where none passed."""
    forward = _integral(time, np.maximum(np.asarray(flow, np.float64), 0.0))
    back = regurgitant_volume(time, flow)
    return np.where(forward > 0, back / np.where(forward > 0, forward, 1.0), 0.0)


class FillingPeaks(NamedTuple):
    """E and A wave: heights, m^3/s, times, s, and their ratio; A and the ratio are nan where there is one wave only."""

    e: float
    a: float
    e_time: float
    a_time: float
    ratio: float


def e_and_a(time: ArrayLike, inflow: ArrayLike) -> FillingPeaks:
    """The waves of a filling curve `(T,)`, m^3/s, positive inwards, at `time` `(T,)`, s.

    E is the first peak, A the last one, of those above a tenth of the highest. Fused waves have two peaks as long as
    the curve dips between them; with one peak there is no A.

    Raises:
        ValueError: the curve never rises above 0.
    """
    found = peaks(time, inflow)
    if not found:
        raise ValueError("e_and_a: there is no inflow: the curve never rises above 0")
    (e_time, e), (a_time, a) = found[0], found[-1]
    if len(found) == 1:
        a_time = a = float("nan")
    return FillingPeaks(e, a, e_time, a_time, e / a)


def peaks(time: ArrayLike, curve: ArrayLike, least: float = LEAST_PEAK) -> list[tuple[float, float]]:
    """Time (s) and height of the maxima of a curve `(T,)` above 0: vertices of parabolas through three samples.

    Args:
        time: `(T,)`, s.
        curve: `(T,)`.
        least: share of the highest below which a maximum, or its rise above the dip beside it, does not count.
    """
    times, values = np.asarray(time, np.float64), np.asarray(curve, np.float64)
    limit = least * max(float(values.max(initial=0.0)), 0.0)
    found: list[tuple[int, float]] = []
    for n in range(len(values)):
        before = values[n - 1] if n else -np.inf
        after = values[n + 1] if n + 1 < len(values) else -np.inf
        if not (values[n] > 0 and values[n] >= limit and values[n] > before and values[n] >= after):
            continue
        if found:
            last, height = found[-1]
            dip = float(values[last : n + 1].min())
            if min(height, values[n]) - dip < limit:  # two humps of one wave: the higher one stays
                if values[n] > height:
                    found[-1] = (n, float(values[n]))
                continue
        found.append((n, float(values[n])))
    return [_vertex(times, values, n) for n, _ in found]


def _vertex(times: Array, values: Array, n: int) -> tuple[float, float]:
    if not 0 < n < len(values) - 1:
        return float(times[n]), float(values[n])
    x = times[n - 1 : n + 2] - times[n]
    a, b, c = np.polyfit(x, values[n - 1 : n + 2], 2)
    if not a < 0:
        return float(times[n]), float(values[n])
    place = -b / (2 * a)
    return float(times[n] + place), float(c - b * b / (4 * a))


def _integral(time: ArrayLike, curve: ArrayLike) -> Array:
    return np.trapezoid(np.asarray(curve, np.float64), np.asarray(time, np.float64), axis=-1)
