"""Plane recordings put into the space that they were taken in, as one measurement of two components at each node."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from geometry.arguments import checked
from geometry.recordings.errors import RecordingError
from geometry.recordings.recording import Recording

from .plane_cut import plane_axes

_LEAST_SHARE = 0.5  # of the weights of a place's neighbours that were measured
_SAME_TIME = 1e-6  # s


@dataclass(frozen=True, eq=False)
class PlacedPlane:
    """A plane recording and where its plane lies.

    Attributes:
        recording: in two dimensions.
        origin: (3,), m, where (0, 0) of the plane is.
        right: (3,), the direction of its x.
        up: (3,), the direction of its y; what it has of ``right`` is taken away.
    """

    recording: Recording
    origin: Sequence[float]
    right: Sequence[float]
    up: Sequence[float]


@checked
def planes_in_space(volume: Recording, planes: Sequence[PlacedPlane]) -> Recording:
    """What planes measured, at the nodes of a volume within half a spacing of them.

    Such a node takes the value at its foot on the nearest plane. A node farther off has weight 0. The recording goes
    through smoothing and the ensemble as any other; its velocities are in the planes, and ``normal`` says which.

    Args:
        volume: gives grid, mask, walls, valves and fluid, at the planes' times; its velocities are not used.
        planes: of the same beat at the same times, say the apical views of two, three and four chambers.

    Raises:
        RecordingError: a plane of other times, or no plane meets the blood.
        ValueError: no planes, planes that are volumes, directions that span no plane.
    """
    if not planes or volume.dimension != 3:
        raise ValueError("planes_in_space: wants a volume and at least one plane")
    shape, frames = volume.grid.shape, volume.frames
    nodes, half = volume.grid.nodes().numpy(), 0.5 * min(volume.grid.spacing)
    velocity, normal = np.zeros((frames, 3, volume.grid.size)), np.zeros((3, volume.grid.size))
    weight, variance = np.zeros((frames, volume.grid.size)), np.full((frames, volume.grid.size), np.nan)
    distance = np.full(len(nodes), np.inf)
    for plane in planes:
        _check(plane.recording, volume)
        axes = plane_axes(plane.right, plane.up)
        place = (nodes - np.asarray(plane.origin, np.float64)) @ axes.T
        near = np.flatnonzero((np.abs(place[:, 2]) <= half) & (np.abs(place[:, 2]) < distance))
        distance[near] = np.abs(place[near, 2])
        seen, known, spread = _seen(plane.recording, place[near, :2])
        velocity[:, :, near] = np.einsum("tcn,ca->tan", seen, axes[:2])
        weight[:, near], variance[:, near], normal[:, near] = known, spread, axes[2][:, None]
    inside = np.asarray(volume.mask, bool)
    weight = weight.reshape(frames, *shape) * inside
    if not weight.any():
        raise RecordingError("planes_in_space", "/mask", "has no node near any plane; check origins and units (m)")
    stated = all(plane.recording.sigma is not None for plane in planes)
    sigma = np.sqrt(np.nan_to_num(variance)).reshape(frames, 1, *shape).repeat(3, 1)
    return replace(
        volume.with_velocity(velocity.reshape(frames, 3, *shape) * inside[:, None], description="planes in space"),
        weight=weight,
        sigma=sigma if stated else None,
        normal=normal.reshape(3, *shape),
    )


def _check(recording: Recording, volume: Recording) -> None:
    if recording.dimension != 2 or recording.beam is not None or recording.nyquist is not None:
        raise ValueError("planes_in_space: wants plane recordings of both components, which do not wrap")
    if recording.frames != volume.frames or np.abs(recording.time - volume.time).max() > _SAME_TIME:
        rule = "differs between a plane and the volume; select the same frames of both"
        raise RecordingError("planes_in_space", "/time", rule)


def _seen(recording: Recording, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Velocity (T, 2, n), weight (T, n) and variance (T, n) of a plane recording at points (n, 2) of it."""
    grid, places = recording.grid, torch.from_numpy(np.ascontiguousarray(points))
    weight = np.asarray(recording.mask, np.float64)
    if recording.weight is not None:
        weight = weight * recording.weight
    found = []
    for frame in range(recording.frames):
        known = weight[frame] > 0
        spread = np.zeros(grid.shape) if recording.sigma is None else (recording.sigma[frame] ** 2).mean(0)
        rows = np.concatenate([recording.velocity[frame], weight[frame][None], spread[None], known[None]])
        sampled = grid.sample(torch.from_numpy(np.where(known, rows, 0.0)), places, outside="zero").numpy()
        share = np.maximum(sampled[4], 1e-9)
        sampled[:4] /= share
        sampled[2] *= sampled[4] >= _LEAST_SHARE
        found.append(sampled)
    every = np.stack(found)
    return every[:, :2], every[:, 2].clip(0, 1), every[:, 3]
