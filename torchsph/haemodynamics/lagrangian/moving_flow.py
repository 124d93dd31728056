"""A velocity at any place and time from the frames of a masked grid, with the walls and orifices around it.

In space multilinear. Beyond the mask the nearest nodes of the blood go on, for as far as a tracer can get before the
wall turns it back. In time linear between two frames, or cubic: the Hermite curve with three-point slopes, which is of
third order (Catmull & Rom 1974 on even frames); a slope at an `event` (a valve) is taken from its own side alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn.functional import grid_sample

import geometry
from geometry.grids.fields import continued

__all__ = ["MovingFlow", "MovingWalls"]

TIME_CURVES = ("linear", "cubic")

ON_THE_RIM = 0.5
"""A tracer that leaves within this many spacings outside the rim of an open orifice left through the orifice."""


class MovingFlow:
    """Velocities between frames.

    Args:
        grid: the nodes.
        time: `(T,)`, s, increasing.
        velocity: `(T, D, *shape)`, m/s.
        mask: bool `(T, *shape)`.
        period: s; 0: the frames are all there is. Otherwise times outside them are brought into them.
        in_time: "linear" or "cubic".
        events: times, s, at which slopes in time jump.
        dtype: of positions and velocities.
        device: where tracers live.

    Raises:
        ValueError: shapes disagree, there are fewer than two frames, one has no blood, or a name is unknown.
    """

    def __init__(
        self,
        grid: geometry.Grid,
        time: ArrayLike,
        velocity: ArrayLike,
        mask: ArrayLike,
        *,
        period: float = 0.0,
        in_time: str = "cubic",
        events: Sequence[float] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        speed, inside = np.asarray(velocity), np.asarray(mask, bool)
        self.grid, self.time, self.period = grid, np.asarray(time, np.float64), float(period)
        if len(self.time) < 2 or speed.shape != (len(self.time), grid.dimension, *grid.shape):
            wanted = (grid.dimension, *grid.shape)
            raise ValueError(f"MovingFlow: velocity must be (T, {wanted}) of 2 frames or more, not {speed.shape}")
        if in_time not in TIME_CURVES:
            raise ValueError(f"MovingFlow: in_time must be one of {TIME_CURVES}, not {in_time!r}")
        if not inside.reshape(len(inside), -1).any(1).all():
            raise ValueError("MovingFlow: a frame has no node in the blood")
        filled = np.stack([continued(v, m) for v, m in zip(speed, inside, strict=True)])
        self.frames = torch.as_tensor(filled, dtype=dtype, device=device)
        self.slopes = self._slopes(events) if in_time == "cubic" else None

    @property
    def start(self) -> float:
        """The first frame, s."""
        return float(self.time[0])

    @property
    def end(self) -> float:
        """The last moment, s: the last frame, or the end of the period."""
        return self.start + self.period if self.period else float(self.time[-1])

    def pieces(self, before: float, after: float) -> list[tuple[float, float, float]]:
        """The way between two times, s, cut at the frames: begin, end and the highest speed, m/s, of every piece."""
        low, high = min(before, after), max(before, after)
        frames = self.time
        if self.period:
            first, last = (int((t - self.start) // self.period) for t in (low, high))
            frames = np.concatenate([self.time + k * self.period for k in range(first, last + 1)])
        cuts = np.concatenate([[low], frames[(frames > low) & (frames < high)], [high]])
        speeds = self.frames.square().sum(1).flatten(1).amax(1).sqrt().tolist()
        found = []
        for begin, end in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
            key = self._locate(0.5 * (begin + end))[0]
            found.append((begin, end, max(speeds[key], speeds[(key + 1) % len(speeds)])))
        return found if after >= before else [(end, begin, speed) for begin, end, speed in reversed(found)]

    def field(self, t: float) -> Tensor:
        """Velocity `(D, *shape)`, m/s, at time `t`, s.

        Raises:
            ValueError: `t` lies outside the frames and there is no period.
        """
        key, place, step = self._locate(t)
        following = (key + 1) % len(self.time)
        if self.slopes is None:
            return torch.lerp(self.frames[key], self.frames[following], place)
        ahead = place * place * (3 - 2 * place)
        first, second = step * place * (1 - place) ** 2, step * place * place * (place - 1)
        blend = torch.lerp(self.frames[key], self.frames[following], ahead)
        return blend + first * self.slopes[key][1] + second * self.slopes[following][0]

    def sample(self, field: Tensor, points: Tensor) -> Tensor:
        """Velocity `(n, D)` at points `(n, D)`, m, of a `field` `(D, *shape)`; off the grid its nearest value."""
        counts = [max(count - 1, 1) for count in reversed(self.grid.shape)]
        place = 2 * self.grid.locate(points) / points.new_tensor(counts) - 1
        spread = place.reshape(1, *[1] * (self.grid.dimension - 1), -1, self.grid.dimension)
        found = grid_sample(field[None], spread, mode="bilinear", padding_mode="border", align_corners=True)
        return found.reshape(self.grid.dimension, -1).T

    def _locate(self, t: float) -> tuple[int, float, float]:
        if self.period:
            t = self.start + (t - self.start) % self.period
        slack = 1e-9 * (self.end - self.start)
        if not self.start - slack <= t <= self.end + slack:
            raise ValueError(f"MovingFlow: the flow is known from {self.start:g} to {self.end:g} s, not at {t:g} s")
        edges = np.append(self.time, self.end) if self.end > self.time[-1] else self.time
        key = int(np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(edges) - 2))
        step = float(edges[key + 1] - edges[key])
        return key, min(max((t - float(edges[key])) / step, 0.0), 1.0), step

    def _slopes(self, events: Sequence[float]) -> list[tuple[Tensor, Tensor]]:
        """Slopes in time of every frame, (towards the frame before, towards the frame after), m/s^2."""
        gaps = np.diff(self.time)
        chords = [(self.frames[n + 1] - self.frames[n]) / gaps[n] for n in range(len(gaps))]
        found = []
        for n in range(len(self.time)):
            if n == 0 or n == len(gaps):
                found.append((chords[max(n - 1, 0)], chords[min(n, len(gaps) - 1)]))
                continue
            middle = (gaps[n] * chords[n - 1] + gaps[n - 1] * chords[n]) / (gaps[n] + gaps[n - 1])
            near = [e for e in events if self.time[n - 1] < e < self.time[n + 1]]
            found.append((chords[n - 1], chords[n]) if near else (middle, middle))
        return found


@dataclass(frozen=True)
class MovingWalls:
    """The walls that tracers meet, and the orifices through which they may leave.

    Args:
        distance: signed distance of the moving wall, positive in the blood.
        orifices: of the wall (`geometry.orifices`).
        intervals: rows (region, opens, closes), s, `(n, 3)`: when an orifice is open.
        period: s; 0: none.
    """

    distance: geometry.MovingDistance
    orifices: Sequence[geometry.Orifice]
    intervals: np.ndarray
    period: float = 0.0

    @classmethod
    def from_recording(cls, recording: geometry.Recording, period: float = 0.0) -> MovingWalls:
        """The walls and valves of a recording."""
        motion = geometry.WallMotion.from_recording(recording)
        grid, step = recording.grid, min(recording.grid.spacing)
        distance = geometry.MovingDistance(grid.padded(2), motion, band=3 * step, keep=4, travel=np.inf)
        return cls(distance, geometry.orifices(motion), recording.valve_intervals_or_derived(), period)

    def meet(self, points: Tensor, t: float) -> tuple[Tensor, Tensor]:
        """Points `(n, D)` brought back into the blood at time `t`, and the region through which each left, `(n,)`.

        0: it did not leave; then a point beyond the wall is set on the wall, where it was closest.
        """
        within = self._within(t)
        field = self.distance.at(within)
        left = torch.zeros(len(points), dtype=torch.long, device=points.device)
        distance = field.distance(points.to(field.table.dtype))
        beyond = torch.nonzero(distance < 0).squeeze(1)
        if len(beyond) == 0:
            return points, left
        places = points[beyond]
        margin = ON_THE_RIM * min(self.distance.grid.spacing)
        for orifice in self.orifices:
            if not self._open(orifice.label, within):
                continue
            plane = orifice.at(within)
            through = (plane.height(places) > -margin) & (plane.lateral_distance(places) > -margin)
            left[beyond[through & (left[beyond] == 0)]] = orifice.label
        stay = beyond[left[beyond] == 0]
        if len(stay) == 0:
            return points, left
        wall = field.at(points[stay].to(field.table.dtype))
        moved = points.clone()
        moved[stay] = points[stay] - (wall.distance[:, None] * wall.normal).to(points.dtype)
        return moved, left

    def _within(self, t: float) -> float:
        start = float(self.distance.motion.time[0])
        return start + (t - start) % self.period if self.period else t

    def _open(self, label: int, t: float) -> bool:
        return any(int(region) == label and opens <= t <= closes for region, opens, closes in self.intervals)
