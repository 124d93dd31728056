"""Flow rates through openings and planes, and what clinics read off their curves.

| quantity | formula | unit |
|---|---|---|
| `OpeningFlow.rate` | Q = -integral of (u - w) . n dA over an orifice, w that of the wall, n out of the blood | m^3/s |
| `plane_flow` | integral of u . n dA over the blood in a plane | m^3/s |
| `stroke_volume` | time integral of the flow that leaves through the outlet, less what returns | m^3 |
| `regurgitant_volume` | time integral of the flow against the valve's own direction | m^3 |
| `regurgitant_fraction` | regurgitant volume over the volume that went the right way | 1 |
| `e_and_a` | the first and the last peak of the filling curve, their ratio and times | m^3/s, s |

(Definitions: Lancellotti et al. 2013, EACVI recommendations on native valvular regurgitation; Nagueh et al. 2016 for E
and A.) No node lies on an orifice, and where its jet is narrow what can be extrapolated to it is a tenth too little. So
Q is taken from the blood in front of it: for div u = 0 and any weight phi that is 1 on the orifice and 0 on the other
ones that are open, by the divergence theorem,

    Q = integral over the wall (shut orifices too) of phi w . n dA - integral over the blood of u . grad phi dV
        + integral over the orifice of w . n dA,

because blood at a wall goes where the wall goes. In a plane that blood passes through div u is not 0, and the integral
of phi div u dV is taken off besides. phi falls from 1 to 0 between the distances `BAND` from the orifice: Q
is the mean of the flow through all surfaces of equal distance in between, each corrected by what the wall beyond it
sweeps. True velocities of the phantom at 1 mm give the volume through inlet and outlet to 0.5 % (a quadratic
extrapolated to the orifice: 8 and 13 % too little).

While one valve alone is open its flow is dV/dt of the walls, which is exact (`geometry.WallMotion.volume_rate`): what
the velocities say beside it is a check of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

import geometry

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


BAND = (1.0, 8.0)
"""Distances from an orifice, in spacings, between which its weight falls from 1 to 0: the first node to be trusted, and
far enough for the grid to resolve the fall."""

OTHERS = (0.1, 0.9)
"""The same for the distance to the orifice over the sum of the distances to it and to the next one that is open."""


class OpeningFlow:
    """The flow rate through one orifice in one frame, for any number of velocities.

    Args:
        grid: the nodes.
        mask: bool `(*shape)`.
        wall: points of the wall at that time, orifices included (`geometry.WallSampler.at`).
        region: label of the orifice.
        others: labels of the other orifices that let blood through at that time.

    Raises:
        ValueError: the wall has no such region.
    """

    def __init__(
        self,
        grid: geometry.Grid,
        mask: ArrayLike,
        wall: geometry.WallPoints,
        region: int,
        others: Sequence[int] = (),
    ) -> None:
        for label in (region, *others):
            if not (wall.region == label).any():
                raise ValueError(f"OpeningFlow: the wall has no region {label}, only {np.unique(wall.region).tolist()}")
        self.grid, self._step = grid, min(grid.spacing)
        self.nodes = np.flatnonzero(np.asarray(mask, bool))
        self._trees = [cKDTree(wall.points[wall.region == region])]
        self._trees += [cKDTree(wall.points[np.isin(wall.region, others)])] if others else []
        flux = wall.areas * (wall.normals * wall.velocities).sum(1)
        volume = float((wall.areas * (wall.normals * wall.points).sum(1)).sum()) / grid.dimension
        on_wall = np.where(wall.region == region, 1.0, self._weight(wall.points))
        on_wall[np.isin(wall.region, others)] = 0.0
        self._swept = float((on_wall * flux).sum())
        slope = self._slope(grid.nodes().numpy()[self.nodes]) * (volume / max(len(self.nodes), 1))
        # a flow that is everywhere alike passes a closed surface as often as it comes: exactly so for these sums too
        size = np.linalg.norm(slope, axis=1)
        lacking = (on_wall * wall.areas) @ wall.normals - slope.sum(0)
        self._weights = -(slope + lacking * (size / max(float(size.sum()), 1e-300))[:, None])
        self._cell = volume / max(len(self.nodes), 1)

    def _weight(self, points: Array) -> Array:
        """phi `(n,)` at `points` `(n, D)`, m."""
        near = self._trees[0].query(points)[0]
        weight = _fall(near / self._step, BAND)
        if len(self._trees) > 1:
            weight = weight * _fall(near / np.maximum(near + self._trees[1].query(points)[0], 1e-300), OTHERS)
        return weight

    def _slope(self, points: Array) -> Array:
        """grad phi `(n, D)`, 1/m, by central differences of a hundredth of a spacing."""
        step = 0.01 * self._step
        moves = step * np.eye(points.shape[1])
        ends = [(self._weight(points + move) - self._weight(points - move)) / (2 * step) for move in moves]
        return np.stack(ends, axis=1)

    def rate(self, velocity: ArrayLike, divergence: ArrayLike | None = None) -> Array:
        """Flow into the blood `(*batch)`, m^3/s, in a plane m^2/s.

        Args:
            velocity: `(*batch, D, *shape)`, m/s.
            divergence: its divergence `(*batch, *shape)`, 1/s, where it has one: in a plane that blood passes through.
        """
        array = np.asarray(velocity)
        lead = array.shape[: array.ndim - 1 - self.grid.dimension]
        values = array.reshape(*lead, self.grid.dimension, -1)[..., self.nodes].astype(np.float64)
        through = np.einsum("...dn,nd->...", values, self._weights) + self._swept
        if divergence is None:
            return through
        gained = np.asarray(divergence, np.float64).reshape(*lead, -1)[..., self.nodes]
        phi = self._weight(self.grid.nodes().numpy()[self.nodes])
        return through - self._cell * (gained @ phi)


def _fall(distance: Array, band: tuple[float, float]) -> Array:
    """1 up to the first end of a band, 0 from the second one on; in between smooth enough to be summed over nodes."""
    part = np.clip((distance - band[0]) / (band[1] - band[0]), 0.0, 1.0)
    return 1 - part**3 * (10 - 15 * part + 6 * part**2)


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
