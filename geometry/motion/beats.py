"""Recordings of several heart beats: one recording a beat, at the phases of one beat; and whether beats repeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arguments import checked
from geometry.recordings.measurement_types import measurement_type
from geometry.recordings.recording import Recording
from geometry.recordings.rules import measured_nodes

_SAME_PHASE = 0.25  # of a frame interval: frames as near in phase as this show the same flow
_FEWEST = 100  # numbers that a comparison wants


@checked
def split_beats(recording: Recording, period: float | None = None) -> list[Recording]:
    """A recording of several beats as one recording a beat, their times counted from the beginning of the first beat.

    Beats are stitched onto one: of frames at phases that the first beat lacks all are kept, and nothing is averaged.
    The first whole beat comes first: its times are those of an analysis, the others are further measurements of it.

    Args:
        recording: of more than one beat.
        period: s, of a beat; None: the recording's own.

    Raises:
        ValueError: the period is not known, or there is no whole beat.
    """
    length = recording.period if period is None else period
    if not length > 0:
        raise ValueError("split_beats: the recording has no period (root attribute); say how long a beat is, in s")
    begin, interval = float(recording.time[0]), float(np.median(np.diff(recording.time)))
    number = np.floor((recording.time - begin) / length + 1e-6).astype(int)
    beats = []
    for beat in range(int(number[-1]) + 1):
        chosen = np.flatnonzero(number == beat)
        if len(chosen) == 0:
            continue
        part = recording.select(chosen)
        shift = beat * length
        valves = recording.valve_intervals
        if valves is not None:
            valves = np.column_stack([valves[:, 0], valves[:, 1:] - shift])
            valves = valves[(valves[:, 2] > begin) & (valves[:, 1] < begin + length)]
        beats.append(replace(part, time=part.time - shift, valve_intervals=valves, period=length))
    whole = [k for k, beat in enumerate(beats) if beat.time[-1] - beat.time[0] > length - 1.5 * interval]
    if not whole:
        raise ValueError(f"split_beats: no beat of {length:g} s is whole in {recording.time[-1] - begin:g} s")
    return [beats[whole[0]], *(beat for k, beat in enumerate(beats) if k != whole[0])]


@dataclass(frozen=True)
class Repetition:
    """How well beats repeat.

    Attributes:
        difference: m/s, deviation of a component of one beat that the difference of beats at equal phase tells of.
        noise: m/s, deviation that the measurement's own noise would make.
        excess: m/s, what is left: by so much the flow itself differs from beat to beat.
        compared: numbers that were compared.
    """

    difference: float
    noise: float
    excess: float
    compared: int

    @property
    def repeats(self) -> bool:
        """Whether what differs is less than half of the noise, in variance."""
        return self.excess**2 < 0.5 * self.noise**2


@checked
def repetition(beats: Sequence[Recording], noise: float | None = None) -> Repetition | None:
    """Compare beats with the first of them; None where too little is measured at equal phases and nodes.

    Two measurements of one flow with independent errors of variance s^2 differ by 2 s^2. Medians stand for variances,
    so that outliers do not count.

    Args:
        beats: as ``split_beats`` gives them.
        noise: m/s, deviation of the errors of a component; None: what the recordings state (``sigma``).

    Raises:
        ValueError: nobody says how large the noise is.
    """
    first, rest = beats[0], beats[1:]
    if noise is None and first.sigma is None:
        raise ValueError("repetition: wants the noise of a component, m/s: the recording states none (/sigma)")
    near = _SAME_PHASE * float(np.median(np.diff(first.time)))
    differences, stated = [], []
    for other in rest:
        if other.grid != first.grid:
            continue
        for frame, time in enumerate(other.time):
            match = int(np.abs(first.time - time).argmin())
            if abs(float(first.time[match] - time)) > near:
                continue
            both = measured_nodes(first)[match] & measured_nodes(other)[frame]
            change = other.velocity[frame].astype(np.float64) - first.velocity[match]
            kind = measurement_type(first)
            parts = change if kind.full else (change[None] * kind.directions(match)).sum(1)
            differences.append(parts[:, both].ravel())
            if noise is None and first.sigma is not None and other.sigma is not None:
                power = first.sigma[match].astype(np.float64) ** 2 + other.sigma[frame].astype(np.float64) ** 2
                stated.append(0.5 * power[:, both].ravel())
    every = np.concatenate(differences) if differences else np.zeros(0)
    if len(every) < _FEWEST:
        return None
    found = 1.4826 * float(np.median(np.abs(every))) / 2**0.5
    own = float(np.sqrt(np.median(np.concatenate(stated)))) if noise is None else noise
    return Repetition(found, own, float(np.sqrt(max(found**2 - own**2, 0.0))), len(every))


@checked
def told_apart(beats: Sequence[Recording], found: Repetition) -> list[Recording]:
    """Beats after the first with what differs from beat to beat added to their errors (``sigma``)."""
    more, made = 2 * found.excess**2, [beats[0]]
    for beat in beats[1:]:
        own = np.full(beat.velocity.shape, found.noise) if beat.sigma is None else beat.sigma
        made.append(replace(beat, sigma=np.sqrt(np.asarray(own, np.float64) ** 2 + more)))
    return made
