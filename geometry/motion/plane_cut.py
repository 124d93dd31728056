"""A plane cut out of a flow in space: velocities in the plane, and the wall as a closed polyline with its openings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from geometry.arguments import POSITIVE, checked
from geometry.grids.grid import Grid
from geometry.recordings.recording import Recording, Wall
from geometry.surfaces.surface import Surface

from .wall_motion import WallMotion

_LEAST_SHARE = 0.5  # of the nodes around a place that must be blood


@dataclass(frozen=True, eq=False)
class _Loop:
    """The section of a surface by a plane, once around the blood, counter-clockwise.

    Attributes:
        points: (n, 2), m, in the plane.
        velocity: (n, 2), m/s, of the wall there.
        region: (n,), of the edge from each point to the next.
    """

    points: np.ndarray
    velocity: np.ndarray
    region: np.ndarray

    def rolled(self, first: int) -> _Loop:
        """The same loop, beginning at another point."""
        return _Loop(*(np.roll(part, -first, 0) for part in (self.points, self.velocity, self.region)))


@checked(spacing=POSITIVE)
def plane_cut(
    recording: Recording,
    origin: Sequence[float],
    right: Sequence[float],
    up: Sequence[float],
    *,
    spacing: float | None = None,
) -> Recording:
    """A plane recording as a probe sees it that images one plane of a flow in space.

    What passes through the plane is not in it: its velocities have a divergence, and ``cut`` says so. The wall's edges
    are the section of the surface at each frame, their openings those that the plane meets.

    Args:
        recording: of a flow in space, with walls.
        origin: (3,), m, a point of the plane, which becomes (0, 0).
        right: (3,), the direction that becomes x.
        up: (3,), in the plane, the direction that becomes y; what it has of ``right`` is taken away.
        spacing: m, of the plane's nodes; None: the smallest of the recording's.

    Returns:
        A recording in two dimensions; of the optional datasets weight, sigma, pressure and valve times are kept.

    Raises:
        ValueError: the recording is a plane itself, directions that span none, or a plane that misses the walls or
            cuts them into several pieces.
    """
    if recording.dimension != 3:
        raise ValueError("plane_cut: the recording is a plane already; cut a volume")
    frame = plane_axes(right, up)
    place = np.asarray(origin, np.float64)
    motion = WallMotion.from_recording(recording)
    wall = _section(motion, recording, place, frame)
    step = float(min(recording.grid.spacing)) if spacing is None else spacing
    lower, upper = wall.vertices.reshape(-1, 2).min(0), wall.vertices.reshape(-1, 2).max(0)
    first = np.floor(lower / step) * step
    counts = np.ceil((upper - first) / step).astype(int) + 1
    grid = Grid(tuple(first.tolist()), (step, step), (int(counts[1]), int(counts[0])))
    points = torch.from_numpy(place + grid.nodes().numpy() @ frame[:2])
    inside = np.asarray(recording.mask, bool)
    share = _sampled(recording.grid, inside[:, None].astype(np.float64), points)[:, 0]

    def on_plane(field: np.ndarray | None) -> np.ndarray | None:
        """(T, C, *shape) of a field (T, C, nz, ny, nx), averaged over the nodes of blood around each place."""
        if field is None:
            return None
        known = np.where(inside[:, None], np.nan_to_num(field), 0.0)
        found = _sampled(recording.grid, known, points) / np.maximum(share, 1e-9)[:, None]
        return found.reshape(*found.shape[:2], *grid.shape)

    mask = (share > _LEAST_SHARE).reshape(-1, *grid.shape)
    return _planar(recording, grid, mask, wall, frame, on_plane)


def plane_axes(right: Sequence[float], up: Sequence[float]) -> np.ndarray:
    """(3, 3) unit vectors: x, y of the plane and its normal."""
    x, y = (np.asarray(part, np.float64) for part in (right, up))
    if x.shape != (3,) or y.shape != (3,) or not np.isfinite([x, y]).all():
        raise ValueError("plane_cut: right and up must be three finite numbers each")
    normal = np.cross(x, y)
    if not np.linalg.norm(normal) > 1e-6 * np.linalg.norm(x) * np.linalg.norm(y):
        raise ValueError("plane_cut: right and up must span a plane")
    x, normal = x / np.linalg.norm(x), normal / np.linalg.norm(normal)
    return np.stack([x, np.cross(normal, x), normal])


def _sampled(grid: Grid, field: np.ndarray, points: torch.Tensor) -> np.ndarray:
    """(T, C, n) of fields (T, C, nz, ny, nx)."""
    return np.stack([grid.sample(torch.from_numpy(np.ascontiguousarray(one)), points).numpy() for one in field])


def _section(motion: WallMotion, recording: Recording, place: np.ndarray, frame: np.ndarray) -> Wall:
    """The wall of the plane: each stretch of one region keeps its number of edges over time."""
    times = recording.time if motion.moves else recording.time[:1]
    loops = [_loop(motion.surface(float(t)), motion.velocity(float(t)), place, frame) for t in times]
    runs = [_runs(loop) for loop in loops]
    labels = [region for region, _ in runs[0]]
    for number, found in enumerate(runs):
        if [region for region, _ in found] != labels:
            said = [region for region, _ in found]
            raise ValueError(
                f"plane_cut: the plane meets the regions {said} at frame {number}, but {labels} at frame 0"
            )
    counts = []
    for stretch in range(len(labels)):
        lengths = [float(np.linalg.norm(np.diff(found[stretch][1].points, axis=0), axis=1).sum()) for found in runs]
        counts.append(max(2, round(np.mean(lengths) / (0.5 * min(recording.grid.spacing)))))
    points, velocity = (
        np.stack(
            [
                np.concatenate([_resampled(run, count)[part] for (_, run), count in zip(found, counts, strict=True)])
                for found in runs
            ]
        )
        for part in (0, 1)
    )
    edges = np.arange(points.shape[1])
    faces, region = np.stack([edges, np.roll(edges, -1)], 1), np.repeat(labels, counts)
    if not motion.moves:
        return Wall(points[0], faces, region)
    return Wall(points, faces, region, velocity=velocity)


def _loop(surface: Surface, velocity: np.ndarray, place: np.ndarray, frame: np.ndarray) -> _Loop:
    """The section of a surface, (nv, 3) of whose velocities are known."""
    height = (surface.vertices - place) @ frame[2]
    height = np.where(height == 0, 1e-12, height)  # a vertex in the plane lies on one side of it
    corner = surface.faces
    above = height[corner] > 0
    cut = np.flatnonzero(above.any(1) & ~above.all(1))
    if not len(cut):
        raise ValueError("plane_cut: the plane does not meet the walls")
    follow: dict[tuple[int, int], tuple[tuple[int, int], int]] = {}
    for face in cut:
        a, b, c = (int(one) for one in corner[face])
        crossed = [(p, q) for p, q in ((a, b), (b, c), (c, a)) if (height[p] > 0) != (height[q] > 0)]
        # seen from the side that the normal points to, the face crosses from its falling edge to its rising one
        falls = next(edge for edge in crossed if height[edge[0]] > 0)
        rises = next(edge for edge in crossed if height[edge[0]] < 0)
        follow[_key(falls)] = (_key(rises), int(surface.region[face]))
    edges, regions = [next(iter(follow))], []
    while True:
        after, region = follow.pop(edges[-1])
        regions.append(region)
        if after == edges[0]:
            break
        edges.append(after)
    if follow:
        raise ValueError("plane_cut: the plane cuts the blood into several pieces; move it")
    p, q = np.array(edges).T
    part = (height[p] / (height[p] - height[q]))[:, None]
    crossing, moving = (field[p] + part * (field[q] - field[p]) for field in (surface.vertices - place, velocity))
    loop = _Loop(crossing @ frame[:2].T, moving @ frame[:2].T, np.array(regions))
    x, y = loop.points.T
    if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) < 0:
        loop = _Loop(loop.points[::-1], loop.velocity[::-1], np.roll(loop.region[::-1], -1))
    return loop


def _key(edge: tuple[int, int]) -> tuple[int, int]:
    return (min(edge), max(edge))


def _runs(loop: _Loop) -> list[tuple[int, _Loop]]:
    """Stretches of one region, the first that of the lowest opening; each with the point that the next begins with."""
    change = np.flatnonzero(loop.region != np.roll(loop.region, 1))
    if not len(change):
        first = int(loop.points[:, 1].argmin())  # nothing tells one point of the wall from another but its place
        loop = loop.rolled(first)
        change = np.zeros(1, int)
    else:
        openings = [int(k) for k in change if loop.region[k] > 0]
        first = min(openings, key=lambda k: loop.region[k])
        loop, change = loop.rolled(first), np.sort((change - first) % len(loop.region))
    ends = [*change[1:].tolist(), len(loop.region)]
    closed = _Loop(*(np.concatenate([part, part[:1]]) for part in (loop.points, loop.velocity, loop.region)))
    return [
        (int(loop.region[a]), _Loop(closed.points[a : b + 1], closed.velocity[a : b + 1], closed.region[a : b + 1]))
        for a, b in zip(change.tolist(), ends, strict=True)
    ]


def _resampled(run: _Loop, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and velocities (count, 2), evenly along a stretch, without its end."""
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(run.points, axis=0), axis=1).cumsum()])
    wanted = along[-1] * np.arange(count) / count
    points, velocity = (
        np.stack([np.interp(wanted, along, column) for column in part.T], 1) for part in (run.points, run.velocity)
    )
    return points, velocity


def _planar(
    recording: Recording,
    grid: Grid,
    mask: np.ndarray,
    wall: Wall,
    frame: np.ndarray,
    on_plane: Callable[[np.ndarray | None], np.ndarray | None],
) -> Recording:
    """The recording of the plane.

    Args:
        recording: of the flow in space.
        grid: of the plane.
        mask: (T, *shape).
        wall: of the plane.
        frame: (3, 3), its unit vectors.
        on_plane: samples fields.
    """
    velocity = on_plane(recording.velocity)
    assert velocity is not None
    weight = None if recording.weight is None else on_plane(recording.weight[:, None])
    pressure = None if recording.pressure is None else on_plane(recording.pressure[:, None])
    sigma = None if recording.sigma is None else on_plane(recording.sigma**2)
    regions, intervals = set(np.unique(wall.region).tolist()), recording.valve_intervals
    return Recording(
        time=recording.time,
        grid=grid,
        velocity=np.einsum("ac,tc...->ta...", frame[:2], velocity) * mask[:, None],
        mask=mask,
        wall=wall,
        rho=recording.rho,
        mu=recording.mu,
        period=recording.period,
        description=f"plane of: {recording.description}",
        weight=None if weight is None else weight[:, 0].clip(0, 1) * mask,
        sigma=None if sigma is None else np.sqrt(np.einsum("ac,tc...->ta...", frame[:2] ** 2, sigma)),
        pressure=None if pressure is None else pressure[:, 0],
        valve_intervals=None if intervals is None else intervals[[int(row[0]) in regions for row in intervals]],
        valve_open=recording.valve_open,
        cut=True,
    )
