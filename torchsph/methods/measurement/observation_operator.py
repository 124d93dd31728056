"""What a measurement sees of a velocity field: blur of its kernel, its own grid, its components, frames and errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

import geometry
from geometry.grids.fields import fwhm_to_deviation, masked_blur
from geometry.recordings.measurement_types import Components
from torchsph.assimilation import Observations, Reason
from torchsph.evaluation.frames import SAME_TIME

from .frame_splines import node_weights
from .prepared import PreparedMeasurement

# share of the nodes around a point that must lie in the blood for the field to be known there
_LEAST_SHARE = 1e-3
# a place that was measured at all keeps some say
_LEAST_CONFIDENCE = 0.02


@dataclass(frozen=True)
class FrameObservations:
    """The observations of one frame of one measurement: m = parts * q numbers at q places, component-major.

    Attributes:
        frame: of the measurement.
        node: (q,) flat indices into the measurement's grid.
        position: (q, D), m.
        observations: their variances as the error model states them.
        components: which components of the velocity they are.
        confidence: (q,) in (0, 1], what a place counts for in a spline.
    """

    frame: int
    node: Tensor
    position: Tensor
    observations: Observations
    components: Components
    confidence: Tensor

    @property
    def parts(self) -> int:
        """Numbers per place."""
        return self.components.parts

    @property
    def limit(self) -> Tensor:
        """(m,) speeds, m/s, at which the numbers wrap; infinite where they do not."""
        each = self.components.limit
        each = torch.full((self.parts,), torch.inf, dtype=torch.float64) if each is None else each
        return each.repeat_interleave(len(self.position))


class Measurement:
    """One measurement of the beat, and what it would see of fields on the grid of the state.

    Args:
        prepared: the recording with its own grid and times, and its error model.
        grid: of the state.
        kernel: full width at half maximum (m) of the measurement's resolution; None takes the error model's.
    """

    def __init__(self, prepared: PreparedMeasurement, grid: geometry.Grid, kernel: float | None = None) -> None:
        self.prepared, self.recording, self.grid = prepared, prepared.recording, grid
        self.type, self.error = prepared.type, prepared.error
        self.kernel = self.error.kernel if kernel is None else kernel
        self.nodes = self.recording.grid.nodes()
        self.same_grid = self.recording.grid == grid

    def frames_within(self, after: float, until: float) -> list[int]:
        """Frames later than ``after`` and not later than ``until`` (s), in order."""
        time = self.recording.time
        return np.flatnonzero((time > after + SAME_TIME) & (time <= until + SAME_TIME)).tolist()

    def see(self, frame: int) -> FrameObservations:
        """The observations of a frame: every node inside the measurement's mask, missing ones with their reason."""
        recording = self.recording
        node = torch.from_numpy(np.flatnonzero(recording.mask[frame]))
        weight = torch.from_numpy(node_weights(recording, frame).astype(np.float64).reshape(-1))[node]
        components = self.type.at(frame, node)
        stated = torch.from_numpy(self.error.variance(recording, frame)).flatten(1)[:, node]
        vectors = torch.from_numpy(recording.velocity[frame].astype(np.float64)).flatten(1)[:, node]
        value, variance = components.of(vectors), components.variance(stated)
        missing = ~torch.isfinite(value).all(0)
        silent = torch.where(missing, int(Reason.MISSING), torch.where(weight > 0, 0, int(Reason.NO_WEIGHT)))
        observations = Observations(
            torch.nan_to_num(value).flatten(),
            torch.where(silent == 0, variance, torch.inf).flatten(),
            position=self.nodes[node],
            redundancy=float(self.error.redundancy[frame]),
            reason=silent.to(torch.uint8).repeat(len(value)),
        )
        confidence = self._confidence(frame, node, silent == 0)
        return FrameObservations(frame, node, self.nodes[node], observations, components, confidence)

    def _confidence(self, frame: int, node: Tensor, used: Tensor) -> Tensor:
        """(q,) inverse deviations relative to the best, without what outliers lose: a spline judges those itself."""
        stated = self.error.variance(self.recording, frame).mean(0) / self.error.surprise[frame]
        calm = torch.from_numpy(stated.reshape(-1))[node]
        if not bool(used.any()):
            return torch.zeros_like(calm)
        best = calm[used].quantile(0.05)
        return torch.where(used, (best / calm).sqrt().clamp(_LEAST_CONFIDENCE, 1.0), 0.0)

    def predict(self, field: Tensor, mask: Tensor, seen: FrameObservations) -> Tensor:
        """What the measurement would see of fields on the state's grid.

        Args:
            field: (B, D, *shape), m/s.
            mask: (*shape) bool, where they are known.
            seen: the observations that are predicted.

        Returns:
            (B, m), NaN at places with no node of the mask around them.
        """
        count, dimension = field.shape[:2]
        flat = field.reshape(count * dimension, *field.shape[2:]).to(torch.float32)
        inside = mask.to(torch.bool)
        if self.kernel > 0:
            flat = masked_blur(flat, inside, fwhm_to_deviation(self.kernel), tuple(self.grid.spacing))
        if self.same_grid:
            known = inside.reshape(-1)[seen.node]
            sampled = flat.flatten(1)[:, seen.node]
        else:
            share = self.grid.sample(inside.to(torch.float32)[None], seen.position)[0]
            known = share > _LEAST_SHARE
            sampled = self.grid.sample(flat * inside, seen.position) / share.clamp_min(_LEAST_SHARE)
        sampled = torch.where(known, sampled, torch.nan).double().reshape(count, dimension, -1)
        return seen.components.of(sampled).flatten(1)
