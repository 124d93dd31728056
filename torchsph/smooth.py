"""The rival: a penalised B-spline field for each frame of a measurement."""

from __future__ import annotations

import numpy as np
import torch
from tqdm import tqdm

import geometry
import regularize

from .wall_rows import wall_rows

# noise and smoothness are chosen in every third frame and serve its neighbours: flow and noise change over tens of
# milliseconds, and a choice costs four times a fit
CHOICE_EVERY = 3


def node_weights(recording: geometry.Recording, frame: int) -> np.ndarray:
    """Confidence (*shape) of a frame's nodes: its weight, or one, inside the mask; 0 where the velocity is missing."""
    mask = np.array(recording.mask[frame], bool)
    ones = mask.astype(np.float32)
    weight = ones if recording.weight is None else np.where(mask, recording.weight[frame], 0.0)
    return np.where(np.isfinite(recording.velocity[frame]).all(0), weight, 0.0)


class FrameSmoother:
    """Spline fits of a recording's frames; neighbouring frames share what was chosen automatically.

    Args:
        recording: the measurement. smoother: options of the fit. choose_every: frames that share one choice.
    """

    def __init__(
        self, recording: geometry.Recording, smoother: regularize.Smoother, choose_every: int = CHOICE_EVERY
    ) -> None:
        if choose_every < 1:
            raise ValueError(f"choose_every must be at least 1, got {choose_every}")
        self.recording, self.smoother, self.choose_every = recording, smoother, choose_every
        self.motion = geometry.WallMotion.from_recording(recording)
        self.nodes = recording.grid.nodes()
        self._choices: dict[int, regularize.Choice | None] = {}

    def choice(self, frame: int) -> regularize.Choice | None:
        """What was chosen for the middle frame of the frame's group; None for a smoother with fixed options."""
        if not self.smoother.automatic:
            return None
        group = frame // self.choose_every
        if group not in self._choices:
            middle = min(group * self.choose_every + self.choose_every // 2, self.recording.frames - 1)
            self._choices[group] = self._fit(middle).choice
        return self._choices[group]

    def fit(self, frame: int, *, uncertainty: bool = False) -> regularize.SplineField:
        """The spline of one frame; ``uncertainty`` keeps what its standard deviation needs.

        Raises ValueError where no node has a positive weight.
        """
        return self._fit(frame, uncertainty=uncertainty, choice=self.choice(frame))

    def fit_increment(
        self, frame: int, innovation: np.ndarray, weight: np.ndarray, choice: regularize.Choice | None
    ) -> regularize.SplineField:
        """The spline of an innovation (D, *shape) with confidences (*shape), whose walls are at rest.

        ``choice``: taken over from an earlier innovation; None chooses from this one.
        """
        return self._fit(frame, innovation, weight, at_rest=True, choice=choice)

    def _fit(
        self, frame: int, velocity: np.ndarray | None = None, weight: np.ndarray | None = None, *,
        at_rest: bool = False, uncertainty: bool = False, choice: regularize.Choice | None = None,
    ) -> regularize.SplineField:
        recording, dimension = self.recording, self.recording.dimension
        field = recording.velocity[frame] if velocity is None else velocity
        weight = node_weights(recording, frame) if weight is None else weight
        mask = torch.from_numpy(np.array(recording.mask[frame], bool).reshape(-1))
        flat_weight = torch.from_numpy(np.asarray(weight, np.float64).reshape(-1))
        used = (flat_weight > 0) & mask
        if not bool(used.any()):
            time = float(recording.time[frame])
            raise ValueError(f"frame {frame} (t = {time:g} s) has no node with a positive weight inside the mask")
        samples = torch.from_numpy(np.nan_to_num(field.reshape(dimension, -1), copy=True)).double().T
        return self.smoother.fit(
            self.nodes[used], samples[used], flat_weight[used],
            wall_rows(recording, self.motion, frame, at_rest=at_rest), divergence_points=self.nodes[mask],
            uncertainty=uncertainty, choice=choice,
        )

    def on_grid(self, fitted: regularize.SplineField, frame: int) -> np.ndarray:
        """The field at the nodes (D, *shape) float32, 0 outside the mask."""
        grid, mask = self.recording.grid, np.array(self.recording.mask[frame], bool).reshape(-1)
        out = np.zeros((grid.dimension, grid.size), np.float32)
        out[:, mask] = fitted(self.nodes[torch.from_numpy(mask)], outside=0.0).T.numpy()
        return out.reshape(grid.dimension, *grid.shape)


def smooth(
    measured: geometry.Recording, smoother: regularize.Smoother | None = None, *, progress: bool = False
) -> geometry.Recording:
    """Fit every frame of a measurement by a penalised B-spline (thesis section 3.2).

    Noise and smoothness are chosen automatically every few frames; outliers are judged in every frame.

    Args:
        measured: the measurement. smoother: options; None takes the default preset.
        progress: show a bar on stderr (only on a terminal).

    Returns:
        A recording on the measurement's grid, mask and times.
    """
    return smooth_frames(FrameSmoother(measured, regularize.Smoother() if smoother is None else smoother), progress)


def smooth_frames(frames: FrameSmoother, progress: bool = False) -> geometry.Recording:
    """``smooth`` with a ``FrameSmoother`` of the caller's, who can then ask it what was chosen."""
    recording = frames.recording
    bar = tqdm(range(recording.frames), desc="spline", disable=None if progress else True, unit="frame")
    fields = np.stack([frames.on_grid(frames.fit(frame), frame) for frame in bar])
    return recording.with_velocity(
        fields, uncovered=np.zeros(recording.frames, np.int64), description="penalised B-spline, frame by frame"
    )
