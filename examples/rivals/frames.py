"""What rivals share: confidences, and the rows of sparse operators over the nodes of a mask."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array

import geometry


def confidence(recording: geometry.Recording) -> np.ndarray:
    """Weights (T, *shape) in [0, 1]; 0 outside the mask and where nothing was measured."""
    mask = np.asarray(recording.mask, bool)
    known = mask & np.isfinite(recording.velocity).all(1)
    weight = np.ones(mask.shape) if recording.weight is None else np.asarray(recording.weight, np.float64)
    return np.where(known, weight, 0.0)


def divergence_rows(mask: np.ndarray, spacing: tuple[float, ...]) -> csr_array:
    """Central differences (n, D m), 1/m, of component-major vectors at the m nodes of a mask.

    A row for each node whose 2 D neighbours lie in the mask.
    """
    number, deep, strides = _numbered(mask)
    dimension, count = mask.ndim, int(mask.sum())
    rows, columns, values = [], [], []
    for component in range(dimension):
        stride = strides[dimension - 1 - component]
        for sign in (1, -1):
            rows.append(np.arange(len(deep)))
            columns.append(component * count + number[deep + sign * stride])
            values.append(np.full(len(deep), sign / (2 * spacing[component])))
    table = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return coo_array(table, shape=(len(deep), dimension * count)).tocsr()


def laplacian_rows(mask: np.ndarray) -> csr_array:
    """Sum of neighbours less the node itself (m, m), over the neighbours that lie in the mask."""
    number, _, strides = _numbered(mask)
    padded = np.pad(mask, 1).reshape(-1)
    nodes = np.flatnonzero(padded)
    rows, columns = [], []
    for stride in strides:
        for sign in (1, -1):
            there = padded[nodes + sign * stride]
            rows.append(number[nodes[there]])
            columns.append(number[nodes[there] + sign * stride])
    row, column = np.concatenate(rows), np.concatenate(columns)
    off = coo_array((np.ones(len(row)), (row, column)), shape=(len(nodes),) * 2).tocsr()
    degree = np.asarray(off.sum(1)).reshape(-1)
    return (off - coo_array((degree, (np.arange(len(nodes)),) * 2), shape=off.shape)).tocsr()


def wall_rows(recording: geometry.Recording, motion: geometry.WallMotion, frame: int) -> tuple[csr_array, np.ndarray]:
    """Rows n . v (k, D m) at nodes within a spacing of a wall (not of an opening), and n . v of the wall there."""
    mask = np.asarray(recording.mask[frame], bool)
    time, count, dimension = float(recording.time[frame]), int(mask.sum()), recording.dimension
    surface = motion.surface(time)
    nodes = recording.grid.nodes().numpy()[mask.reshape(-1)]
    found = geometry.SurfaceIndex(surface).query(nodes)
    near = np.flatnonzero((np.abs(found.distance) < min(recording.grid.spacing)) & (surface.region[found.face] == 0))
    normal = surface.normals[found.face[near]]
    asked = (found.interpolate(surface, motion.velocity(time))[near] * normal).sum(1)
    row = np.tile(np.arange(len(near)), dimension)
    column = np.concatenate([component * count + near for component in range(dimension)])
    return coo_array((normal.T.reshape(-1), (row, column)), shape=(len(near), dimension * count)).tocsr(), asked


def _numbered(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Number of each node of the padded mask, flat indices of nodes with all neighbours, strides slowest axis first."""
    padded = np.pad(mask, 1)
    number = np.full(padded.size, -1)
    flat = np.flatnonzero(padded.reshape(-1))
    number[flat] = np.arange(len(flat))
    strides = [int(np.prod(padded.shape[axis + 1 :])) for axis in range(mask.ndim)]
    inside = padded.reshape(-1)
    deep = flat[np.all([inside[flat + sign * stride] for stride in strides for sign in (1, -1)], axis=0)]
    return number, deep, strides
