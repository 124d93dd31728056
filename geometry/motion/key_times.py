"""The times at which fields of a moving wall are made: more of them than key frames, or fewer, by how it moves.

Fields of the wall (distance, normal, velocity) on a grid stand at these times and are linear in time between them, as
the two textures of Grønli 2017, sec. 3.1.3.
"""

from __future__ import annotations

import bisect
import math

import numpy as np

from .wall_motion import WallMotion

# between two key times the wall's path may leave the straight line by this part of the longest path ...
_LARGEST_BEND = 0.02
# ... where key times are put between key frames; key frames are left out only where it is far less than that, and the
# velocity as near to linear, as a part of the fastest wall's
_SPARED_BEND, _SPARED_VELOCITY = 0.01, 0.01
_SAMPLES = 4
# between two key frames: each asks for a field of its own, and of so many no computer makes all
_MOST_TIMES = 100_000


class KeyTimes:
    """Increasing times (s) between which a wall's fields may be taken as linear in time.

    Args:
        motion: the wall.
        spacing: of the particles or of the fields' grid, m.
        longest_path: between two key times no vertex goes farther than this (spacings); an indicator of the fluid
            would smear else. inf: key frames alone count.

    Attributes:
        times: s, increasing.
    """

    def __init__(self, motion: WallMotion, spacing: float, *, longest_path: float = 1.0) -> None:
        self.motion, self.longest_path = motion, longest_path
        self.times: list[float] = [float(t) for t in motion.time]
        if motion.moves:
            keys = _spared(motion, spacing, longest_path)
            spans = zip(keys, keys[1:], strict=False)
            added = [t for early, late in spans for t in _between(motion, early, late, spacing, longest_path)]
            self.times = sorted([float(motion.time[k]) for k in keys] + added)

    def bracket(self, time: float) -> tuple[int, int, float, float]:
        """Numbers of the key times before and after ``time`` (s), and these times in the present period.

        Off the key frames of a motion without a period the first or the last two key times.
        """
        if len(self.times) == 1:
            return 0, 0, time, time
        shift = self._shift(time)
        late = min(max(bisect.bisect_left(self.times, time - shift), 1), len(self.times) - 1)
        return late - 1, late, self.times[late - 1] + shift, self.times[late] + shift

    def within(self, start: float, stop: float) -> list[float]:
        """The key times in [start, stop] (s), in every period."""
        if len(self.times) == 1:
            return []
        found = [t for t in self.times if start <= t <= stop]
        if self.motion.period:
            # a time outside the key frames stands for one in the nearest period of them (WallMotion.locate)
            first, last, period = self.times[0], self.times[-1], self.motion.period
            for beat in range(max(1, math.floor((start - last) / period)), math.ceil((stop - last) / period) + 1):
                found += [t + beat * period for t in self.times if t > last - period]
            for beat in range(max(1, math.floor((first - stop) / period)), math.ceil((first - start) / period) + 1):
                found += [t - beat * period for t in self.times if t < first + period]
        return sorted({t for t in found if start <= t <= stop})

    def wrapped(self, time: float) -> float:
        """The time (s) among the key frames that ``time`` stands for, by the motion's period."""
        return time - self._shift(time)

    def _shift(self, time: float) -> float:
        first, last, period = self.times[0], self.times[-1], self.motion.period
        if not period or first <= time <= last:
            return 0.0
        beats = math.ceil((time - last) / period) if time > last else -math.ceil((first - time) / period)
        return beats * period


def _spared(motion: WallMotion, spacing: float, longest: float) -> list[int]:
    """Key frames that are needed: those between which the others lie on a straight path, passed at linear velocity."""
    fastest = float(np.linalg.norm(motion.rates_at_keys, axis=2).max())
    kept, last = [0], len(motion.time) - 1
    while kept[-1] < last:
        start = stop = kept[-1]
        stop += 1
        while stop < last and _straight(motion, start, stop + 1, spacing, longest, fastest):
            stop += 1
        kept.append(stop)
    return kept


def _straight(motion: WallMotion, start: int, stop: int, spacing: float, longest: float, fastest: float) -> bool:
    """Whether the key frames between two may be left out."""
    x, v, t = motion.vertices_at_keys, motion.rates_at_keys, motion.time
    if np.linalg.norm(x[stop] - x[start], axis=1).max() > longest * spacing:
        return False
    part = ((t[start + 1 : stop] - t[start]) / (t[stop] - t[start]))[:, None, None]
    bend = np.abs(x[start + 1 : stop] - x[start] - part * (x[stop] - x[start])).max()
    unlike = np.abs(v[start + 1 : stop] - v[start] - part * (v[stop] - v[start])).max()
    return bend <= _SPARED_BEND * spacing and unlike <= _SPARED_VELOCITY * fastest


def _between(motion: WallMotion, start: int, stop: int, spacing: float, longest: float) -> list[float]:
    """Key times to put between two key frames that follow each other."""
    if stop > start + 1 or not math.isfinite(longest):
        return []
    early, late = float(motion.time[start]), float(motion.time[stop])
    parts = np.arange(_SAMPLES + 1) / _SAMPLES
    places = np.stack([motion.vertices(early + part * (late - early)) for part in parts])
    path = np.linalg.norm(np.diff(places, axis=0), axis=2).sum(0).max()
    straight = places[0] + parts[:, None, None] * (places[-1] - places[0])
    bend = np.linalg.norm(places - straight, axis=2).max()
    # cut in n, a curve leaves its chords by 1 / n^2 of what it leaves the whole one
    step = max(longest * spacing, 1e-300)  # m
    count = math.ceil(min(max(path / step, math.sqrt(bend / (_LARGEST_BEND * step))), 1e300) - 1e-9)
    if count > _MOST_TIMES:
        raise ValueError(
            f"the wall moves {path:.3g} m between {early:g} and {late:g} s, which asks for {count:.3g} key times at "
            f"{step:.3g} m each, more than {_MOST_TIMES}: spacing and wall must be in m, and the path between key "
            "times (travel) a part of a spacing that can be gone"
        )
    return [early + k / count * (late - early) for k in range(1, count)]
