"""How far apart samples lie: what a default that is a length or a time goes by."""

from collections.abc import Sequence
from math import pi

import numpy as np
import torch
from scipy.spatial import cKDTree

from regularize.errors import InvalidInput

NEIGHBOURS = 16  # whose distance gives the density of scattered samples
LOOKED_AT = 2000  # samples whose neighbours are looked for
EVEN = 1e-3  # of a step: gaps on a lattice are whole steps up to this (coordinates may have been stored in float32)
FEWEST_PER_STEP = 2  # samples that share a coordinate on a lattice; scattered ones share none


def space_steps(points: torch.Tensor) -> tuple[float, ...]:
    """Distances between neighbouring samples along each axis of space.

    Args:
        points: (n, D), m.

    Returns:
        D distances, m: the steps of a lattice (a grid, masked or not); for scattered samples the edge of the cell
        that each of them has for itself, the same along all axes.

    Raises:
        InvalidInput: all samples lie at one point.
    """
    cloud = points.detach().double().cpu().numpy()
    steps = [lattice_step(column) for column in cloud.T]
    flat = [len(np.unique(column)) == 1 for column in cloud.T]
    if all(flat):
        raise InvalidInput("all samples lie at one point: give the knot distance, knots, in m")
    known = [step for step in steps if step is not None]
    if len(known) + sum(flat) == len(steps):
        return tuple(max(known) if step is None else step for step in steps)
    return (_scattered_step(cloud[:, ~np.array(flat)]),) * len(steps)


def time_step(times: torch.Tensor) -> float:
    """Distance between frames of sample times (n,), s; InvalidInput where the samples share no frames."""
    column = times.detach().double().cpu().numpy()
    frames = np.unique(column)
    if len(frames) < 2 or len(column) < FEWEST_PER_STEP * len(frames):
        raise InvalidInput("the times of the samples form no frames: give time_knots, the knot distance in s")
    return float(np.median(np.diff(frames)))


def lattice_step(column: np.ndarray) -> float | None:
    """Step of coordinates (n,) of which many agree and all lie whole steps apart; None where they do not."""
    reach = float(np.ptp(column))
    different = np.sort(column)
    different = different[np.diff(different, prepend=-np.inf) > 1e-6 * reach]
    if len(different) < 2 or len(column) < FEWEST_PER_STEP * len(different):
        return None
    gaps = np.diff(different)
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    return step if bool((np.abs(gaps / step - np.rint(gaps / step)) < EVEN * np.rint(gaps / step)).all()) else None


def _scattered_step(cloud: np.ndarray) -> float:
    """From the volume that holds a few neighbours of a typical sample."""
    count, dimension = cloud.shape
    nearest = min(NEIGHBOURS, count - 1)
    asked = cloud[np.random.default_rng(0).permutation(count)[:LOOKED_AT]]
    reach = np.median(cKDTree(cloud).query(asked, k=[nearest + 1])[0])
    ball = {1: 2.0, 2: pi, 3: 4 * pi / 3}[dimension]
    if not reach > 0:
        raise InvalidInput("most samples lie at one point: give the knot distance, knots, in m")
    return float(reach * (ball / nearest) ** (1 / dimension))


def mean_length(lengths: Sequence[float]) -> float:
    """Geometric mean, exact where all are equal."""
    first = float(lengths[0])
    return first if all(length == first for length in lengths) else float(np.exp(np.mean(np.log(lengths))))
