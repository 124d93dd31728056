"""Refining a surface: edges longer than a spacing are halved until none is left, without hanging vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, eye_array, vstack

from geometry.arguments import checked
from geometry.surfaces.surface import Surface, SurfaceError

from .wall_motion import WallMotion

MOST_FACES = 20_000_000  # several gigabytes; a spacing that asks for more is a mistake of units


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined surface, the old face of each face `(nf,)`, and `weights` (nv, old nv) of its vertices."""

    surface: Surface
    parent: np.ndarray
    weights: csr_array


@checked
def refined(surface: Surface, spacing: float) -> Surface:
    """The same surface with all edges at most `spacing` (m) long, so that flat parts carry vertices too."""
    return refinement(surface, spacing).surface


@checked
def refined_motion(motion: WallMotion, spacing: float) -> WallMotion:
    """The same motion with its surface refined; new vertices move with the faces they lie on.

    Edges are measured at the first key frame. Enclosed volume and its rate stay what they were, to round-off.
    """
    result = refinement(motion.surface(float(motion.time[0])), spacing)
    vertices, rates = (
        np.stack([result.weights @ frame for frame in frames])
        for frames in (motion.vertices_at_keys, motion.rates_at_keys)
    )
    return WallMotion(motion.time, vertices, rates, result.surface.faces, result.surface.region, motion.period)


def refinement(surface: Surface, spacing: float) -> Refinement:
    """Halve edges longer than `spacing` (m), and cut the faces beside them, until there is none."""
    if not 0 < spacing < 1e100:
        raise SurfaceError(f"refined: spacing must be a positive length (m), not {spacing}")
    finest = np.maximum(surface.areas / (0.43 * spacing ** (surface.dimension - 1)), 1).sum()
    if finest > MOST_FACES:
        raise SurfaceError(f"refined: a spacing of {spacing:g} m asks for {finest:.1g} faces: is it in m?")
    weights = eye_array(len(surface.vertices), format="csr")
    parent = np.arange(len(surface.faces))
    while True:
        faces, ends, source = _halved(surface, spacing)
        if len(ends) == 0:
            return Refinement(surface, parent, csr_array(weights))
        rows, half = np.repeat(np.arange(len(ends)), 2), np.full(2 * len(ends), 0.5)
        middle = csr_array(coo_array((half, (rows, ends.ravel())), shape=(len(ends), weights.shape[0])))
        weights = vstack([weights, middle @ weights], format="csr")
        vertices = np.concatenate([surface.vertices, surface.vertices[ends].mean(axis=1)])
        surface, parent = Surface(vertices, faces, surface.region[source]), parent[source]


def _halved(surface: Surface, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """New faces, the ends `(m, 2)` of the edges that were halved, and the old face of each new one."""
    faces, count = surface.faces.astype(np.int64), len(surface.vertices)
    if surface.dimension == 2:
        long = np.flatnonzero(surface.areas > spacing)
        middle = count + np.arange(len(long))
        kept = np.delete(np.arange(len(faces)), long)
        cut = [np.column_stack([faces[long, 0], middle]), np.column_stack([middle, faces[long, 1]])]
        return np.concatenate([faces[kept], *cut]), faces[long], np.concatenate([kept, long, long])
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)  # side k joins corners k and k + 1
    low, high = sides.min(axis=2), sides.max(axis=2)
    key, place = np.unique(low * count + high, return_inverse=True)
    ends = np.column_stack(np.divmod(key, count))
    long = np.linalg.norm(surface.vertices[ends[:, 0]] - surface.vertices[ends[:, 1]], axis=1) > spacing
    number = np.full(len(key), -1, np.int64)
    number[long] = count + np.arange(long.sum())
    new, source = _cut_faces(surface.vertices, faces, number[place.reshape(faces.shape)])
    return new, ends[long], source


def _cut_faces(vertices: np.ndarray, faces: np.ndarray, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut triangles by the new vertices on their sides (-1: none) into 2, 3 or 4, as sides are halved."""
    halved = (middle >= 0).sum(axis=1)
    parts, source = [faces[halved == 0]], [np.flatnonzero(halved == 0)]

    def rotated(rows: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        order = (first[:, None] + np.arange(3)) % 3
        return np.take_along_axis(faces[rows], order, 1), np.take_along_axis(middle[rows], order, 1)

    rows = np.flatnonzero(halved == 1)
    f, m = rotated(rows, (middle[rows] >= 0).argmax(axis=1))
    parts += [np.column_stack([f[:, 0], m[:, 0], f[:, 2]]), np.column_stack([m[:, 0], f[:, 1], f[:, 2]])]
    source += [rows, rows]

    rows = np.flatnonzero(halved == 2)
    f, m = rotated(rows, ((middle[rows] < 0).argmax(axis=1) + 1) % 3)  # sides 0 and 1 are halved, 2 is not
    parts.append(np.column_stack([m[:, 0], f[:, 1], m[:, 1]]))
    # The rest is a quadrilateral f0, m0, m1, f2: cut along its shorter diagonal.
    one = np.linalg.norm(_at(vertices, f, m, 0) - vertices[f[:, 2]], axis=1)
    other = np.linalg.norm(_at(vertices, f, m, 1) - vertices[f[:, 0]], axis=1)
    first = (one < other)[:, None]
    parts.append(
        np.where(first, np.column_stack([f[:, 0], m[:, 0], f[:, 2]]), np.column_stack([f[:, 0], m[:, 0], m[:, 1]]))
    )
    parts.append(
        np.where(first, np.column_stack([m[:, 0], m[:, 1], f[:, 2]]), np.column_stack([f[:, 0], m[:, 1], f[:, 2]]))
    )
    source += [rows] * 3

    rows = np.flatnonzero(halved == 3)
    f, m = faces[rows], middle[rows]
    parts += [np.column_stack([f[:, k], m[:, k], m[:, (k + 2) % 3]]) for k in range(3)] + [m]
    source += [rows] * 4
    return np.concatenate(parts), np.concatenate(source)


def _at(vertices: np.ndarray, faces: np.ndarray, middle: np.ndarray, side: int) -> np.ndarray:
    """Where the new vertex on a side will be."""
    return 0.5 * (vertices[faces[:, side]] + vertices[faces[:, (side + 1) % 3]])
