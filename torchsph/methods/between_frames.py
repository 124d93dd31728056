"""The flow of an analysis at any time and place, between its frames as the model has it.

From each frame the model is run to the next one. What it misses there is known, and what imposing the frame on
particles lost is known as well; in between both are taken to come in evenly. At time t, the part w of the way from
frame a to frame b,

    v(t) = f(t) + (1 - w) (v_a - f(a)) + w (v_b - f(b)),

f being the forecast as it is fetched from the particles. So the frames are met exactly, an error of the forecast that
grows linearly is taken out exactly, and what the forecast adds to a straight line in time is its own curvature: jets
that travel, vortices that turn. (The straight line alone is `model=None`.)

The deviation is that of a random walk which is known at both ends (a Brownian bridge): what the frames claim, linear
in variance, and w (1 - w) times the square of what the forecast missed, averaged over a few nodes.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

import geometry
from geometry.arguments import checked, finite
from geometry.grids.fields import continued, masked_blur
from torchsph.evaluation.frames import SAME_TIME
from torchsph.evaluation.metrics import filled_velocity, gaps
from torchsph.simulator.failures import NumericalFailure
from torchsph.simulator.grid_forecast import GridForecast, Transfer
from torchsph.simulator.simulator import Simulator

AROUND = 2.0
"""Grid spacings, deviation of the Gaussian that averages the squares of what a forecast missed."""


class FlowAt(NamedTuple):
    """Velocities at points.

    Args:
        velocity: `(times, n, D)`, m/s; 0 outside the blood.
        sigma: `(times, n, D)`, m/s, or None where the analysis claims none.
        inside: bool `(times, n)`, whether a point is in the blood.
    """

    velocity: np.ndarray
    sigma: np.ndarray | None
    inside: np.ndarray


class Snapshot(NamedTuple):
    """A moment: velocity and sigma `(D, *shape)`, m/s; masks bool `(*shape)`; nodes that the forecast left out."""

    velocity: np.ndarray
    sigma: np.ndarray | None
    mask: np.ndarray
    uncovered: int


@dataclass(frozen=True)
class _Interval:
    """Two frames, and what is to be added to a forecast from one to the other: `(D, *shape)` each, m/s."""

    times: tuple[float, float]
    lost: Tensor
    missed: Tensor

    def correction(self, t: float) -> Tensor:
        return torch.lerp(self.lost, self.missed, self.share(t))

    def share(self, t: float) -> float:
        return (t - self.times[0]) / (self.times[1] - self.times[0])


class BetweenFrames:
    """A recording's flow at any time from its first frame to its last.

    Args:
        recording: an analysis, or any flow without gaps.
        model: simulator of its scene, as `make_model` gives it; None: straight lines between frames.
        seed: of the particles.

    Attributes:
        failures: frames from which the model failed, with the reason; there the lines are straight, as a warning says.

    Raises:
        ValueError: fewer than two frames, a frame without blood, or nodes in the blood without a value.
    """

    @checked
    def __init__(self, recording: geometry.Recording, model: Simulator | None = None, *, seed: int = 0) -> None:
        if recording.frames < 2:
            raise ValueError(f"BetweenFrames: between takes at least 2 frames, not {recording.frames}")
        self.recording, self.model, self.seed = recording, model, seed
        self.time = np.asarray(recording.time, np.float64)
        self.masks = np.array(recording.mask, bool)
        if not self.masks.reshape(len(self.masks), -1).any(1).all():
            raise ValueError("BetweenFrames: a frame has no node in the blood")
        missing = gaps(recording)
        if missing.any():
            first = int(np.argwhere(missing)[0, 0])
            rule = f"nothing is known at {int(missing.sum())} nodes in the blood, first at frame {first}"
            raise ValueError(f"BetweenFrames: {rule}; smooth or assimilate the measurement first")
        self.velocity = filled_velocity(recording).astype(np.float32)
        self.motion = None if recording.wall is None else geometry.WallMotion.from_recording(recording)
        self.failures: dict[int, str] = {}

    @checked(times=finite(), points=finite())
    def at(self, times: ArrayLike, points: ArrayLike) -> FlowAt:
        """Velocity and deviation at all points at all times.

        On the recording's own grid, and from there linear in space: nothing finer than the grid. For more,
        `resampled` on a finer grid.

        Args:
            times: `(times,)`, s, in any order.
            points: `(n, D)`, m.

        Raises:
            ValueError: a time outside the frames.
        """
        places = torch.from_numpy(np.asarray(points, np.float64).reshape(-1, self.recording.dimension))
        wanted = np.atleast_1d(np.asarray(times, np.float64))
        order = np.argsort(wanted, kind="stable")
        count, dimension = len(places), self.recording.dimension
        velocity = np.zeros((len(wanted), count, dimension))
        inside = np.zeros((len(wanted), count), bool)
        sigma = None if self.recording.sigma is None else np.zeros_like(velocity)
        grid = self.recording.grid
        stencil, near = grid.stencil(places), grid.contains(places).numpy()
        for number, moment in zip(order, self.moments(wanted[order], grid), strict=True):
            share = grid.sample(torch.from_numpy(moment.mask.astype(np.float64)), stencil).numpy()
            inside[number] = self._enclosed(places.numpy(), float(wanted[number]), share) & near & (share > 0)
            known = inside[number][:, None]
            velocity[number] = np.where(known, _sampled(grid, moment.velocity, moment.mask, stencil), 0.0)
            if sigma is not None and moment.sigma is not None:
                sigma[number] = np.where(known, _sampled(grid, moment.sigma, moment.mask, stencil), 0.0)
        return FlowAt(velocity, sigma, inside)

    @checked
    def moments(self, times: Sequence[float] | np.ndarray, grid: geometry.Grid) -> Iterator[Snapshot]:
        """The flow on a grid, one moment after the other.

        Args:
            times: s, increasing or equal.
            grid: of the fields; the recording's own keeps frames exactly.

        Raises:
            ValueError: a time outside the frames, or one before its predecessor.
        """
        wanted = np.asarray(times, np.float64)
        first, last = self.time[0] - SAME_TIME, self.time[-1] + SAME_TIME
        if not ((wanted >= first) & (wanted <= last)).all():
            raise ValueError(
                f"BetweenFrames: the flow is known from {self.time[0]:g} to {self.time[-1]:g} s, not beyond"
            )
        if (np.diff(wanted) < 0).any():
            raise ValueError("BetweenFrames.moments: times must not decrease")
        keys = np.clip(np.searchsorted(self.time, wanted + SAME_TIME, side="right") - 1, 0, len(self.time) - 2)
        for key in np.unique(keys):
            yield from self._between(int(key), [float(t) for t in wanted[keys == key]], grid)

    def _between(self, key: int, times: list[float], grid: geometry.Grid) -> Iterator[Snapshot]:
        masks = [self._mask(key, t, grid) for t in times]
        own = grid == self.recording.grid
        at_frames = own and all(np.abs(self.time[key : key + 2] - t).min() <= SAME_TIME for t in times)
        forecast = None if self.model is None or at_frames else self._forecast(key, times, masks, grid)
        for number, (t, mask) in enumerate(zip(times, masks, strict=True)):
            frame = key + int(abs(t - self.time[key]) > abs(t - self.time[key + 1]))
            if own and abs(t - self.time[frame]) <= SAME_TIME:
                yield Snapshot(self.velocity[frame], self._claim(frame), self.masks[frame], 0)
                continue
            line = self._line(key, t, grid)
            missed, missing, field = None, 0, line
            if forecast is not None:
                interval, fields, covered = forecast
                value = fields[number] + self._moved(interval.correction(t), grid)
                field = torch.where(covered[number], value, line)
                missing, missed = int((mask & ~covered[number].numpy()).sum()), interval.missed - interval.lost
            velocity = np.where(mask, field.numpy(), 0.0).astype(np.float32)
            yield Snapshot(velocity, self._deviation(key, t, missed, mask, grid), mask, missing)

    def _forecast(
        self, key: int, times: list[float], masks: list[np.ndarray], grid: geometry.Grid
    ) -> tuple[_Interval, list[Tensor], list[Tensor]] | None:
        """What the model makes of frame `key`: the interval, fields (D, *shape) and covered (*shape) at the times."""
        assert self.model is not None
        try:
            return self._run(self.model, key, times, masks, grid)
        except NumericalFailure as fault:
            self.failures[key] = str(fault)
            warnings.warn(
                f"the model failed after {self.time[key]:g} s ({fault}); the flow is linear in time from there to "
                f"{self.time[key + 1]:g} s",
                RuntimeWarning,
                stacklevel=5,
            )
            return None

    def _run(
        self, model: Simulator, key: int, times: list[float], masks: list[np.ndarray], grid: geometry.Grid
    ) -> tuple[_Interval, list[Tensor], list[Tensor]]:
        own, device = self.recording.grid, model.device
        start, end = (torch.from_numpy(mask).to(device) for mask in self.masks[key : key + 2])
        before, after = (torch.from_numpy(field) for field in self.velocity[key : key + 2])
        began, ends = (float(t) for t in self.time[key : key + 2])
        going = GridForecast(model, own, before.to(device), start, began, Transfer(fade=None), seed=self.seed)
        kept = going.run.fetch(own, start).value[0].cpu()
        fields, covered = [], []
        for t, mask in zip(times, masks, strict=True):
            going.run.advance(min(t, ends))
            found = going.run.fetch(grid, torch.from_numpy(mask).to(device))
            fields.append(found.value[0].cpu())
            covered.append(found.covered[0].cpu())
        going.run.advance(ends)
        come = going.run.fetch(own, end)
        reached = self.masks[key + 1] & come.covered[0].cpu().numpy()
        lost = _continued(before - kept, self.masks[key])
        missed = _continued(after - come.value[0].cpu(), reached) if reached.any() else lost
        return _Interval((began, ends), lost, missed), fields, covered

    def _line(self, key: int, t: float, grid: geometry.Grid) -> Tensor:
        """The straight line between two frames, (D, *shape), m/s, continued beyond their masks."""
        ends = [_continued(torch.from_numpy(self.velocity[n]), self.masks[n]) for n in (key, key + 1)]
        return self._moved(torch.lerp(ends[0], ends[1], self._share(key, t)), grid)

    def _deviation(
        self, key: int, t: float, missed: Tensor | None, mask: np.ndarray, grid: geometry.Grid
    ) -> np.ndarray | None:
        if self.recording.sigma is None:
            return None
        share, own = self._share(key, t), self.recording.grid
        claims = [_continued(torch.from_numpy(self.recording.sigma[n]), self.masks[n]).square() for n in (key, key + 1)]
        variance = torch.lerp(claims[0], claims[1], share)
        if missed is None:  # of a straight line all that has changed is what it may have missed
            ends = [_continued(torch.from_numpy(self.velocity[n]), self.masks[n]) for n in (key, key + 1)]
            missed = ends[1] - ends[0]
        both = torch.from_numpy(self.masks[key] | self.masks[key + 1])
        local = masked_blur(missed.square(), both, AROUND * min(own.spacing), own.spacing)
        variance = variance + share * (1 - share) * _continued(local, both.numpy())
        return np.where(mask, self._moved(variance, grid).clamp_min(0).sqrt().numpy(), 0.0).astype(np.float32)

    def _share(self, key: int, t: float) -> float:
        return float((t - self.time[key]) / (self.time[key + 1] - self.time[key]))

    def _claim(self, frame: int) -> np.ndarray | None:
        return None if self.recording.sigma is None else self.recording.sigma[frame]

    def _moved(self, field: Tensor, grid: geometry.Grid) -> Tensor:
        """A field (D, *shape) of the recording's grid on another."""
        if grid == self.recording.grid:
            return field
        return self.recording.grid.sample(field, grid.nodes().to(field.dtype)).reshape(-1, *grid.shape)

    def _mask(self, key: int, t: float, grid: geometry.Grid) -> np.ndarray:
        """Nodes in the blood (*shape): on the recording's grid as both frames have it, else as the wall says."""
        own = grid == self.recording.grid
        early, late = self.masks[key], self.masks[key + 1]
        nearest = late if self._share(key, t) > 0.5 else early
        if self.motion is None:
            if own:
                return nearest
            nodes = grid.nodes()
            share = self.recording.grid.sample(torch.from_numpy(nearest.astype(np.float64)), nodes)
            return np.asarray(share.numpy() >= 0.5).reshape(grid.shape)
        if own and np.array_equal(early, late):
            return early
        inside = geometry.grid_winding(grid, self.motion.vertices(t), self.motion.faces).reshape(grid.shape) > 0
        return np.where(early == late, early, inside) if own else np.asarray(inside)

    def _enclosed(self, points: np.ndarray, t: float, share: np.ndarray) -> np.ndarray:
        """Whether points (n, D) lie within the wall; without one, where half of the nodes around are blood."""
        if self.motion is None:
            return np.asarray(share >= 0.5)
        return np.asarray(geometry.winding_number(self.motion.vertices(t), self.motion.faces, points) > 0.5)


def _sampled(grid: geometry.Grid, field: np.ndarray, mask: np.ndarray, stencil: geometry.Stencil) -> np.ndarray:
    """A field (D, *shape) at points, (n, D), the nearest nodes of the blood going on beyond it."""
    everywhere = _continued(torch.from_numpy(np.asarray(field, np.float64)), mask)
    return grid.sample(everywhere, stencil).numpy().T


def _continued(field: Tensor, mask: np.ndarray) -> Tensor:
    """A field (D, *shape) with the value of the nearest node of the mask outside it."""
    return torch.from_numpy(continued(field.numpy(), mask))
