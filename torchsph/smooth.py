"""The rival: a penalised B-spline field for each frame of a measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from tqdm import tqdm

import geometry
import regularize

from .wall_rows import wall_rows

# frames, spread over the recording, from which its noise and smoothness are chosen
CHOICE_FRAMES = 3


def node_weights(recording: geometry.Recording, frame: int) -> np.ndarray:
    """Confidence (*shape) of a frame's nodes: its weight, or one, inside the mask; 0 where the velocity is missing."""
    mask = np.asarray(recording.mask[frame], bool)
    ones = mask.astype(np.float32)
    weight = ones if recording.weight is None else np.where(mask, recording.weight[frame], 0.0)
    return np.where(np.isfinite(recording.velocity[frame]).all(0), weight, 0.0)


class FrameSmoother:
    """Spline fits of a recording's frames that share what was chosen automatically.

    Args:
        recording: the measurement. smoother: options of the fit. choice: noise and smoothness chosen before, or None.
    """

    def __init__(
        self, recording: geometry.Recording, smoother: regularize.Smoother,
        choice: regularize.Choice | None = None,
    ) -> None:
        self.recording, self.smoother, self.choice = recording, smoother, choice
        self.motion = geometry.WallMotion.from_recording(recording)
        self.nodes = recording.grid.nodes()

    def choose(self, frames: int = CHOICE_FRAMES) -> None:
        """Choose noise, smoothness and slip once: the geometric means over some frames (automatic smoothers only)."""
        if not self.smoother.automatic:
            return
        count = self.recording.frames
        picked = np.unique(np.linspace(0, count - 1, min(frames, count) + 2)[1:-1].round().astype(int))
        found = [self.fit(int(frame)).choice for frame in picked]
        known = [one for one in found if one is not None]
        if known:
            self.choice = _mean_choice(known)

    def fit(
        self, frame: int, velocity: np.ndarray | None = None, weight: np.ndarray | None = None, *,
        at_rest: bool = False, uncertainty: bool = False, anew: bool = False,
    ) -> regularize.SplineField:
        """The spline of one frame.

        ``velocity`` (D, *shape) and ``weight`` (*shape) replace the frame's own, for instance by an innovation, whose
        walls are ``at_rest``. ``anew``: choose from this very field, whatever was chosen before.

        Raises ValueError where no node has a positive weight.
        """
        recording, dimension = self.recording, self.recording.dimension
        field = recording.velocity[frame] if velocity is None else velocity
        weight = node_weights(recording, frame) if weight is None else weight
        mask = torch.from_numpy(np.asarray(recording.mask[frame], bool).reshape(-1))
        flat_weight = torch.from_numpy(np.asarray(weight, np.float64).reshape(-1))
        used = (flat_weight > 0) & mask
        if not bool(used.any()):
            time = float(recording.time[frame])
            raise ValueError(f"frame {frame} (t = {time:g} s) has no node with a positive weight inside the mask")
        samples = torch.from_numpy(np.nan_to_num(field.reshape(dimension, -1), copy=True)).double().T
        return self.smoother.fit(
            self.nodes[used], samples[used], flat_weight[used],
            wall_rows(recording, self.motion, frame, at_rest=at_rest), divergence_points=self.nodes[mask],
            uncertainty=uncertainty, choice=None if anew else self.choice,
        )

    def on_grid(self, fitted: regularize.SplineField, frame: int) -> np.ndarray:
        """The field at the nodes (D, *shape) float32, 0 outside the mask."""
        grid, mask = self.recording.grid, np.asarray(self.recording.mask[frame], bool).reshape(-1)
        out = np.zeros((grid.dimension, grid.size), np.float32)
        out[:, mask] = fitted(self.nodes[torch.from_numpy(mask)], outside=0.0).T.numpy()
        return out.reshape(grid.dimension, *grid.shape)


def _mean_choice(choices: list[regularize.Choice]) -> regularize.Choice:
    """Geometric means of noise, curvature and slip; a slip that some frames leave free counts where it was chosen."""

    def mean(values: list[float]) -> float:
        return float(np.exp(np.mean(np.log(np.maximum(values, 1e-12)))))

    noise = tuple(mean([c.noise[k] for c in choices]) for k in range(len(choices[0].noise)))
    slips = [c.no_slip for c in choices if c.no_slip]
    return replace(
        choices[0], noise=noise, curvature=mean([c.curvature for c in choices]), no_slip=mean(slips) if slips else None
    )


def smooth(
    measured: geometry.Recording, smoother: regularize.Smoother | None = None, *, progress: bool = False
) -> geometry.Recording:
    """Fit every frame of a measurement by a penalised B-spline (thesis section 3.2).

    Noise and smoothness are chosen once, from a few frames; outliers are judged in every frame.

    Args:
        measured: the measurement. smoother: options; None takes the default preset.
        progress: show a bar on stderr (only on a terminal).

    Returns:
        A recording on the measurement's grid, mask and times.
    """
    return smooth_frames(FrameSmoother(measured, regularize.Smoother() if smoother is None else smoother), progress)


def smooth_frames(frames: FrameSmoother, progress: bool = False) -> geometry.Recording:
    """``smooth`` with a ``FrameSmoother`` of the caller's, which keeps what was chosen."""
    if frames.choice is None:
        frames.choose()
    recording = frames.recording
    bar = tqdm(range(recording.frames), desc="spline", disable=None if progress else True, unit="frame")
    fields = np.stack([frames.on_grid(frames.fit(frame), frame) for frame in bar])
    return recording.with_velocity(
        fields, uncovered=np.zeros(recording.frames, np.int64), description="penalised B-spline, frame by frame"
    )
