"""The motion of a wall between key frames: positions, velocities, enclosed volume and its exact rate.

Between two key frames every vertex follows the cubic Hermite curve through its two positions with its two
velocities (the recording's, or else three-point differences of the positions, second order on uneven frames).
The volume rate is the derivative of the volume of that very motion, not a difference, so that continuity can
be closed to round-off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from geometry.arguments import checked, finite
from geometry.recordings.recording import Recording
from geometry.surfaces.surface import Surface


@checked
@dataclass(frozen=True, eq=False)
class WallMotion:
    """A surface of fixed faces at key frames.

    `time` (K,) s, increasing; `vertices` (K, nv, D) m; `rates` (K, nv, D) m/s; `faces`, `region` as in
    `Surface`; `period` s, 0 = none. A single key frame is a wall at rest, valid at every time. Otherwise
    times outside the key frames raise ValueError, unless there is a period, which wraps them.
    """

    time: np.ndarray
    vertices_at_keys: np.ndarray
    rates_at_keys: np.ndarray
    faces: np.ndarray
    region: np.ndarray
    period: float = 0.0

    def __post_init__(self) -> None:
        if self.time.ndim != 1 or len(self.time) == 0 or (np.diff(self.time) <= 0).any():
            raise ValueError("WallMotion: time must be (K,) and increase strictly")
        for name in ("vertices_at_keys", "rates_at_keys"):
            shape = getattr(self, name).shape
            if len(shape) != 3 or shape[0] != len(self.time) or shape != self.vertices_at_keys.shape:
                raise ValueError(f"WallMotion: {name} must be ({len(self.time)}, nv, D), not {shape}")
        if self.period and self.time[-1] - self.time[0] < self.period * (1 - 1e-9):
            raise ValueError("WallMotion: a periodic motion needs key frames over the whole period")

    @classmethod
    @checked
    def from_recording(cls, recording: Recording) -> WallMotion:
        """The motion of a recording's wall, with `/wall/velocity` where it is given.

        With a period that the frames do not fill, the first key frame is repeated a period later.
        """
        wall, time = recording.wall_for("the motion of the wall"), recording.time
        if not wall.moves or recording.frames == 1:
            return cls.at_rest(wall.at(0))
        vertices, rates = wall.vertices, wall.velocity
        if rates is not None:
            rates = rates.astype(np.float64)
        end = time[0] + recording.period
        if recording.period and time[-1] < end:
            # A last frame just before the end would leave a key interval next to nothing long: drop it.
            keep = time < end - 0.1 * (time[-1] - time[-2])
            time = np.append(time[keep], end)
            vertices = np.concatenate([vertices[keep], vertices[:1]])
            rates = None if rates is None else np.concatenate([rates[keep], rates[:1]])
        return cls.through(time, vertices, wall.faces, wall.region, rates=rates, period=recording.period)

    @classmethod
    @checked(time=finite(None), vertices=finite(None, None, None), rates=finite())
    def through(
        cls,
        time: np.ndarray,
        vertices: np.ndarray,
        faces: np.ndarray,
        region: np.ndarray,
        *,
        rates: np.ndarray | None = None,
        period: float = 0.0,
    ) -> WallMotion:
        """The motion through key frames.

        Args:
            time: (K,), s, increasing.
            vertices: (K, nv, D), m.
            faces: (nf, D), vertex numbers.
            region: (nf,), labels.
            rates: (K, nv, D), m/s; None: three-point differences of the vertices.
            period: s, 0 = none.
        """
        time, vertices = np.asarray(time, np.float64), np.asarray(vertices, np.float64)
        if not len(time) or len(vertices) != len(time):
            raise ValueError(f"WallMotion.through: vertices of {len(vertices)} key frames for {len(time)} times")
        if rates is None:
            rates = _differences(time, vertices, period)
        return cls(time, vertices, np.asarray(rates, np.float64), faces, region, period)

    @classmethod
    @checked
    def at_rest(cls, surface: Surface) -> WallMotion:
        """A wall that does not move."""
        vertices = surface.vertices[None]
        return cls(np.zeros(1), vertices, np.zeros_like(vertices), surface.faces, surface.region)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.vertices_at_keys.shape[2]

    @property
    def moves(self) -> bool:
        """Whether there is more than one key frame."""
        return len(self.time) > 1

    @checked
    def vertices(self, t: float) -> np.ndarray:
        """Vertex positions at time `t` (s), `(nv, D)`, m."""
        key, s, step = self.locate(t)
        if not self.moves:
            return self.vertices_at_keys[0]
        ahead = s * s * (3 - 2 * s)
        return self._blend(key, (1 - ahead, ahead, step * s * (1 - s) ** 2, step * s * s * (s - 1)))

    @checked
    def velocity(self, t: float) -> np.ndarray:
        """Vertex velocities at time `t`, `(nv, D)`, m/s: the exact derivative of `vertices`."""
        key, s, step = self.locate(t)
        if not self.moves:
            return self.rates_at_keys[0]
        slope = 6 * s * (1 - s) / step
        return self._blend(key, (-slope, slope, (1 - s) * (1 - 3 * s), s * (3 * s - 2)))

    @checked
    def surface(self, t: float) -> Surface:
        """The surface at time `t`."""
        return self._first.moved(self.vertices(t))

    @cached_property
    def _first(self) -> Surface:
        """The surface of the first key frame, which knows what all others share."""
        surface = Surface(self.vertices_at_keys[0], self.faces, self.region)
        _ = surface.is_closed, surface.component_labels
        return surface

    @checked
    def volume(self, t: float) -> float:
        """Enclosed volume at time `t`, m^3 (area, m^2, in a plane)."""
        return self.surface(t).volume

    @checked
    def volume_rate(self, t: float, region: int | None = None) -> float:
        """dV/dt at time `t`, m^3/s: the flux swept by the moving faces, all or those of one region.

        Over a closed surface of plane faces whose vertices move with u, dV/dt = sum_f A_f . mean(u) exactly,
        A_f being the outward area vector: the divergence theorem for a velocity linear on each face.
        """
        surface = self.surface(t)
        swept = (surface.area_vectors * self.velocity(t)[self.faces].mean(axis=1)).sum(axis=1)
        return float(swept.sum() if region is None else swept[self.region == region].sum())

    @checked
    def travel(self, key: int) -> float:
        """The longest way (m) that a vertex moves from key frame `key` to the next."""
        step = self.vertices_at_keys[key + 1] - self.vertices_at_keys[key]
        return float(np.sqrt((step * step).sum(axis=1)).max())

    @checked
    def locate(self, t: float) -> tuple[int, float, float]:
        """Key interval of a time, place in it in [0, 1], its length (s); ValueError off the key frames."""
        if not math.isfinite(t):
            raise ValueError(f"WallMotion: time must be finite, not {t}")
        if not self.moves:
            return 0, 0.0, 0.0
        start, end = float(self.time[0]), float(self.time[-1])
        if self.period and not start <= t <= end:
            # Into the nearest period that is covered; of several recorded beats each keeps its own motion.
            beats = math.ceil((t - end) / self.period) if t > end else -math.ceil((start - t) / self.period)
            t -= beats * self.period
        # Sums of time steps miss the last frame by round-off.
        slack = 1e-6 * (end - start) / (len(self.time) - 1)
        if not start - slack <= t <= end + slack:
            raise ValueError(f"WallMotion: the wall is known from {start:g} to {end:g} s, not at {t:g} s")
        key = int(np.clip(np.searchsorted(self.time, t, side="right") - 1, 0, len(self.time) - 2))
        step = float(self.time[key + 1] - self.time[key])
        return key, min(max((t - float(self.time[key])) / step, 0.0), 1.0), step

    def _blend(self, key: int, weights: tuple[float, float, float, float]) -> np.ndarray:
        a, b, c, d = weights
        vertices, rates = self.vertices_at_keys, self.rates_at_keys
        return a * vertices[key] + b * vertices[key + 1] + c * rates[key] + d * rates[key + 1]


def _differences(time: np.ndarray, vertices: np.ndarray, period: float) -> np.ndarray:
    """Three-point differences, second order on uneven steps too; around the end where that is a period's."""
    if len(time) < 2:
        return np.zeros_like(vertices)
    if abs(time[-1] - time[0] - period) > 1e-9 * (time[-1] - time[0]):
        return np.gradient(vertices, time, axis=0, edge_order=1 if len(time) == 2 else 2)
    time = np.concatenate([[time[-2] - period], time, [time[1] + period]])
    vertices = np.concatenate([vertices[-2:-1], vertices, vertices[1:2]])
    return np.gradient(vertices, time, axis=0)[1:-1]
