"""Vortices in space and in a plane: where they are, how large, how strong.

In space a vortex core is a connected region where lambda2 < -threshold (Jeong & Hussain 1995). A ring, whole or bent
and broken, is described by what does not depend on its outline (Saffman 1992), with r the distance
from its axis e and w the vorticity around that axis:

    centre      mean place of the core, weighted with abs(omega)                    [m]
    axis        direction of the impulse 1/2 integral of (x - centre) x omega dV
    circulation Gamma = 1/(2 pi) integral of w / r dV                                [m^2/s]
    radius      sqrt(I / (pi Gamma)), I = 1/2 integral of r w dV                     [m]

In a plane the vortex is the connected region with Q > 0 whose circulation is largest; its numbers are those that echo
labs use (Hong et al. 2008; HyperDoppler: Fiorencis et al. 2022; definitions as tabulated in a review of
intraventricular flow by imaging, doi 10.1186/s12947-021-00269-8):

    area        of the vortex over the area of the blood in the plane               [1]
    depth       distance of its centre from the base, over the ventricle's length   [1]
    length      its extent from base to apex, over the ventricle's length           [1]
    width       its extent across, over the ventricle's width                       [1]
    intensity   its circulation, integral of omega over it                          [m^2/s]
    sphericity  width over length, in metres both                                   [1]
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import generate_binary_structure, label

import geometry

from .fields.sampling import PlaneSection

__all__ = ["PlaneCore", "PlaneVortex", "VortexRing", "main_vortex", "plane_cores", "vortex_cores", "vortex_ring"]

Array = NDArray[np.float64]


def vortex_cores(lambda2: ArrayLike, mask: ArrayLike, threshold: float = 0.0) -> tuple[NDArray[np.int64], int]:
    """Connected regions with lambda2 < -threshold: labels `(*shape)`, 1 the one of most nodes, 0 outside; their number.

    Args:
        lambda2: `(*shape)`, 1/s^2.
        mask: bool `(*shape)`.
        threshold: 1/s^2, 0 or more.
    """
    core = (np.asarray(lambda2) < -threshold) & np.asarray(mask, bool)
    labels, count = label(core, generate_binary_structure(core.ndim, core.ndim))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    rank = np.zeros(count + 1, np.int64)
    rank[1 + np.argsort(-sizes, kind="stable")] = np.arange(1, count + 1)
    return rank[labels], count


class VortexRing(NamedTuple):
    """A ring: see the head of this file; `volume` m^3 of the nodes that it was read from."""

    centre: Array
    axis: Array
    circulation: float
    radius: float
    volume: float


def vortex_ring(vorticity: ArrayLike, core: ArrayLike, grid: geometry.Grid) -> VortexRing | None:
    """The ring in a region of nodes; `None` where there is no rotation about an axis in it.

    Args:
        vorticity: `(3, *shape)`, 1/s.
        core: bool `(*shape)`, the nodes that belong to the ring.
        grid: the nodes.
    """
    chosen = np.flatnonzero(np.asarray(core, bool))
    curl = np.asarray(vorticity, np.float64).reshape(3, -1)[:, chosen].T
    size = np.linalg.norm(curl, axis=1)
    if not size.sum() > 0:
        return None
    points = grid.nodes().numpy()[chosen]
    centre = size @ points / size.sum()
    place = points - centre
    impulse = 0.5 * np.cross(place, curl).sum(0) * grid.cell_volume
    strength = float(np.linalg.norm(impulse))
    if not strength > 0:
        return None
    axis = impulse / strength
    across = place - (place @ axis)[:, None] * axis
    distance = np.linalg.norm(across, axis=1)
    away = distance > 0
    around = np.cross(axis, across[away]) / distance[away, None]
    swirl = (curl[away] * around).sum(1)
    circulation = float((swirl / distance[away]).sum() * grid.cell_volume / (2 * np.pi))
    own = float(0.5 * (swirl * distance[away]).sum() * grid.cell_volume)
    radius = float(np.sqrt(own / (np.pi * circulation))) if own * circulation > 0 else float("nan")
    return VortexRing(centre, axis, circulation, radius, len(chosen) * grid.cell_volume)


class PlaneVortex(NamedTuple):
    """The main vortex of a plane: see the head of this file; `centre` (s, t), m, in the plane's coordinates."""

    centre: Array
    area: float
    depth: float
    length: float
    width: float
    intensity: float
    sphericity: float


def main_vortex(gradient: ArrayLike, section: PlaneSection) -> PlaneVortex | None:
    """The strongest vortex of the blood in a plane whose `along` points from apex to base; `None` without one.

    Args:
        gradient: in-plane velocity gradient `(2, 2, nt, ns)`, 1/s: [i, j] = du_i / dx_j, 0 is across, 1 along.
        section: the plane.
    """
    tensor = np.asarray(gradient, np.float64)
    curl = tensor[1, 0] - tensor[0, 1]
    # Q of a plane flow without divergence in the plane: -det G
    turning = (tensor[0, 0] * tensor[1, 1] - tensor[0, 1] * tensor[1, 0] > 0) & section.inside
    labels, count = label(np.where(turning, np.sign(curl), 0) > 0)
    others, more = label(np.where(turning, np.sign(curl), 0) < 0)
    labels = np.where(others > 0, others + count, labels)
    if count + more == 0:
        return None
    strengths = np.bincount(labels.ravel(), weights=curl.ravel(), minlength=count + more + 1)[1:] * section.pixel_area
    chosen = labels == 1 + int(np.argmax(np.abs(strengths)))
    intensity = float(strengths[np.argmax(np.abs(strengths))])
    weight = np.abs(curl) * chosen
    centre = np.array([(weight * section.s).sum(), (weight * section.t[:, None]).sum()]) / weight.sum()
    low, high = _extent(section.t, np.any(section.inside, axis=1))
    left, right = _extent(section.s, np.any(section.inside, axis=0))
    bottom, top = _extent(section.t, np.any(chosen, axis=1))
    first, last = _extent(section.s, np.any(chosen, axis=0))
    return PlaneVortex(
        centre,
        float(chosen.sum() / section.inside.sum()),
        float((high - centre[1]) / (high - low)),
        (top - bottom) / (high - low),
        (last - first) / (right - left),
        intensity,
        (last - first) / (top - bottom),
    )


class PlaneCore(NamedTuple):
    """A vortex of a plane recording: circulation, m^2/s, area, m^2, centre `(2,)`, m, weighted with abs(omega)."""

    circulation: float
    area: float
    centre: Array


def plane_cores(
    vorticity: ArrayLike, turning: ArrayLike, grid: geometry.Grid
) -> tuple[PlaneCore | None, PlaneCore | None]:
    """The vortex of the largest circulation that turns from x to y, and the one that turns back; `None` without one.

    Args:
        vorticity: `(ny, nx)`, 1/s.
        turning: bool `(ny, nx)`, nodes of the blood at which paths turn (`vorticity.swirl` above 0).
        grid: the nodes.
    """
    curl, inside = np.asarray(vorticity, np.float64), np.asarray(turning, bool)
    found = [_strongest(np.where(inside, np.maximum(sign * curl, 0.0), 0.0), sign, grid) for sign in (1, -1)]
    return found[0], found[1]


def _strongest(size: Array, sign: int, grid: geometry.Grid) -> PlaneCore | None:
    """The connected region of the largest sum of `size` `(ny, nx)`."""
    labels, count = label(size > 0)
    if not count:
        return None
    sums = np.bincount(labels.ravel(), weights=size.ravel(), minlength=count + 1)[1:]
    chosen = np.flatnonzero(labels.ravel() == 1 + int(sums.argmax()))
    weight = size.ravel()[chosen]
    centre = weight @ grid.nodes().numpy()[chosen] / weight.sum()
    return PlaneCore(sign * float(weight.sum()) * grid.cell_volume, len(chosen) * grid.cell_volume, centre)


def _extent(ticks: Array, used: NDArray[np.bool_]) -> tuple[float, float]:
    """Ends of the pixels in use, m: half a pixel beyond their middles."""
    half = 0.5 * float(ticks[1] - ticks[0])
    found = np.flatnonzero(used)
    return float(ticks[found[0]]) - half, float(ticks[found[-1]]) + half
