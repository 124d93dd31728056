"""The rival: a penalised B-spline field for each frame of a measurement."""

from __future__ import annotations

import numpy as np
import torch
from tqdm import tqdm

import geometry
import regularize

from .wall_rows import wall_rows


def node_weights(recording: geometry.Recording, frame: int) -> np.ndarray:
    """Confidence (*shape) of a frame's nodes: its weight, or one, inside the mask; 0 where the velocity is missing."""
    mask = np.asarray(recording.mask[frame], bool)
    weight = mask.astype(np.float32) if recording.weight is None else np.where(mask, recording.weight[frame], 0.0)
    return np.where(np.isfinite(recording.velocity[frame]).all(0), weight, 0.0)


def smooth_frame(
    recording: geometry.Recording, motion: geometry.WallMotion, frame: int, smoother: regularize.Smoother,
    velocity: np.ndarray | None = None, weight: np.ndarray | None = None, *, at_rest: bool = False,
) -> np.ndarray:
    """Spline fit of one frame evaluated at the nodes, (D, *shape) float32, 0 outside the mask.

    ``velocity`` (D, *shape) and ``weight`` (*shape) replace the frame's own, for instance by an innovation, whose
    walls are ``at_rest``.
    """
    field = recording.velocity[frame] if velocity is None else velocity
    weight = node_weights(recording, frame) if weight is None else weight
    grid, mask = recording.grid, np.asarray(recording.mask[frame], bool).reshape(-1)
    nodes = grid.nodes()
    used = torch.from_numpy((weight.reshape(-1) > 0) & mask)
    if not bool(used.any()):
        raise ValueError(f"frame {frame} (t = {recording.time[frame]:g} s) has no node with a positive weight in the mask")
    flat = torch.from_numpy(np.nan_to_num(field.reshape(grid.dimension, -1), copy=True)).double().T
    fitted = smoother.fit(
        nodes[used], flat[used], torch.from_numpy(weight.reshape(-1)).double()[used],
        wall_rows(recording, motion, frame, at_rest=at_rest), divergence_points=nodes[torch.from_numpy(mask)],
    )
    out = np.zeros((grid.dimension, grid.size), np.float32)
    inside = torch.from_numpy(np.flatnonzero(mask))
    out[:, mask] = fitted(nodes[inside], outside=0.0).T.numpy()
    return out.reshape(grid.dimension, *grid.shape)


def smooth(
    measured: geometry.Recording, smoother: regularize.Smoother | None = None, *, progress: bool = False
) -> geometry.Recording:
    """Fit every frame of a measurement by a penalised B-spline (thesis section 3.2).

    Args:
        measured: the measurement. smoother: options; None takes the default preset.
        progress: show a bar on stderr (only on a terminal).

    Returns:
        A recording on the measurement's grid, mask and times.
    """
    smoother = regularize.Smoother() if smoother is None else smoother
    motion = geometry.WallMotion.from_recording(measured)
    frames = tqdm(range(measured.frames), desc="spline", disable=None if progress else True, unit="frame")
    fields = np.stack([smooth_frame(measured, motion, frame, smoother) for frame in frames])
    return measured.with_velocity(
        fields, uncovered=np.zeros(measured.frames, np.int64), description="penalised B-spline, frame by frame"
    )
