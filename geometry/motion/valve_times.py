"""When the openings of a wall are open, read off the volume that the wall moves and the flow beside the openings.

Blood cannot be compressed: while the cavity grows something is open that lets it in, and while it shrinks something
that lets it out. A recording that does not say when its valves open is given those phases; one that says something
that cannot be is corrected, and told so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from geometry.arguments import checked
from geometry.recordings.recording import Recording

from .orifices import orifices
from .wall_estimate import WallEstimate, estimate_wall
from .wall_motion import WallMotion

# samples of dV/dt per frame interval
_FINE = 8
# dV/dt means flow where it exceeds this part of its largest value, and this many deviations
_LEAST, _DEVIATIONS = 0.02, 3.0
# an opening takes part in a phase where its mean flow is at least this part of the largest one's
_PART = 0.1
# depth (largest grid spacings) inside an opening in which measured velocities tell its flow
_DEPTH = 1.5
INLET, OUTLET = 1, 2


@dataclass(frozen=True, eq=False)
class ValveTimes:
    """Times at which openings open and close.

    Attributes:
        intervals: (n, 3) rows (region, opens, closes), s.
        error: (n, 2) s, how far the opening and the closing may be off; 0 where the file's word stands.
        source: "given", "corrected" or "found".
        changes: one sentence for each time that was found or corrected.
    """

    intervals: np.ndarray
    error: np.ndarray
    source: str
    changes: tuple[str, ...] = ()

    def applied(self, recording: Recording) -> Recording:
        """The recording with these intervals; itself where the given ones stand."""
        if self.source == "given":
            return recording
        return replace(recording, valve_intervals=self.intervals, valve_open=None)


@dataclass(frozen=True)
class _Phase:
    """A stretch of time in which the cavity grows (sign 1) or shrinks (-1), s."""

    sign: int
    start: float
    stop: float
    start_error: float
    stop_error: float


@checked
def find_valve_times(recording: Recording, estimate: WallEstimate | None = None) -> ValveTimes:
    """Openings' times of a recording: given, corrected where dV/dt says that they cannot be, or found.

    With the openings 1 and 2 alone, 1 lets in and 2 lets out. Of others the flow measured beside them tells in which
    phases they take part. Openings of a wall that keeps its volume are always open.

    Args:
        recording: with walls.
        estimate: its walls' motion, where that has been estimated and applied already.

    Raises:
        RecordingError: the recording has no wall.
    """
    if estimate is None:
        estimate = estimate_wall(recording)
        recording = estimate.applied(recording)
    given = recording.valve_intervals_or_derived()
    labels = sorted({int(label) for label in recording.wall_for("valve times").region if label > 0})
    if not labels:
        return ValveTimes(given, np.zeros((len(given), 2)), "given")
    motion = WallMotion.from_recording(recording)
    phases = _phases(recording, motion, estimate)
    if not len(given):
        return _found(recording, motion, labels, phases)
    return _corrected(recording, motion, labels, phases, given)


def _ends(recording: Recording) -> tuple[float, float]:
    """What a recording speaks of, s: a period, or its frames and half a frame interval on both sides."""
    time = recording.time
    if recording.period:
        return float(time[0]), float(max(time[-1], time[0] + recording.period))
    margin = 0.5 * float(np.diff(time).max()) if len(time) > 1 else 1.0
    return float(time[0]) - margin, float(time[-1]) + margin


def _phases(recording: Recording, motion: WallMotion, estimate: WallEstimate) -> list[_Phase]:
    """Filling and emptying in turn; between two phases of one sense nothing closes."""
    if not motion.moves:
        return []
    key = motion.time
    share = np.arange(_FINE) / _FINE
    fine = np.append((key[:-1, None] + share * np.diff(key)[:, None]).ravel(), key[-1])
    rate = np.array([motion.volume_rate(t) for t in fine])
    sigma = np.interp(fine, estimate.time, estimate.rate_sigma)
    least = np.maximum(_LEAST * np.abs(rate).max(), _DEVIATIONS * sigma)
    sign = np.where(np.abs(rate) > least, np.sign(rate), 0).astype(int)
    flowing = np.flatnonzero(sign)
    if not len(flowing):
        return []
    breaks = np.flatnonzero(np.diff(sign[flowing]) != 0)
    starts, stops = np.append(flowing[0], flowing[breaks + 1]), np.append(flowing[breaks], flowing[-1])
    errors = least / np.maximum(np.abs(np.gradient(rate, fine)), 1e-300)
    first, last = _ends(recording)
    limits = [first, *(0.5 * (fine[a] + fine[b]) for a, b in zip(stops[:-1], starts[1:], strict=True)), last]
    found = []
    for number, (a, b) in enumerate(zip(starts, stops, strict=True)):
        # flow begins before it is seen to, by as long as dV/dt at its slope there needs, but not in another phase;
        # open a little too long does no harm where nothing flows, shut where something does
        begins = first if a == 0 else max(fine[a] - errors[a], limits[number])
        ends = last if b == len(fine) - 1 else min(fine[b] + errors[b], limits[number + 1])
        found.append(_Phase(int(sign[a]), begins, ends, fine[a] - begins, ends - fine[b]))
    return found


def _takers(recording: Recording, motion: WallMotion, labels: list[int], phases: list[_Phase]) -> dict[int, set[int]]:
    """For each sense of flow the openings that take part in it."""
    if set(labels) <= {INLET, OUTLET} or len(labels) == 1:
        inlets = {labels[0]} if len(labels) == 1 else {INLET}
        return {1: inlets, -1: {labels[-1]} if len(labels) == 1 else {OUTLET}}
    flows = {label: measured_flow(recording, motion, label) for label in labels}
    takers = {}
    for sense in (1, -1):
        during = np.zeros(recording.frames, bool)
        for phase in phases:
            if phase.sign == sense:
                during |= (recording.time >= phase.start) & (recording.time <= phase.stop)
        mean = {label: _mean(value[during], error[during]) for label, (value, error) in flows.items()}
        largest = max(abs(value) for value, _ in mean.values())
        part = {
            label
            for label, (value, error) in mean.items()
            if abs(value) > max(_PART * largest, _DEVIATIONS * error) and largest > 0
        }
        takers[sense] = part or set(labels)
    return takers


def _mean(value: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """Mean of values and its error."""
    good = np.isfinite(value)
    if not good.any():
        return 0.0, 0.0
    return float(value[good].mean()), float(np.sqrt((error[good] ** 2).sum()) / good.sum())


def measured_flow(recording: Recording, motion: WallMotion, label: int) -> tuple[np.ndarray, np.ndarray]:
    """Volume flow (T,) that the measured velocities tell at the openings of a region, m^3/s, inwards; its error."""
    nodes = recording.grid.nodes()
    depth = _DEPTH * float(np.max(recording.grid.spacing))
    value, error = np.zeros((2, recording.frames))
    for opening in (one for one in orifices(motion) if one.label == label):
        for frame, time in enumerate(recording.time):
            t = float(time)
            height = opening.height(nodes, t)
            near = (height <= 0) & (height > -depth)
            row = torch.nonzero(near).squeeze(1)
            row = row[opening.lateral_distance(nodes[row], t) > 0]
            seen = row.numpy()[np.asarray(recording.mask[frame]).reshape(-1)[row.numpy()]]
            field = recording.velocity[frame].reshape(recording.dimension, -1)[:, seen]
            along = -(field.T - opening.velocity(t)) @ opening.normal(t)
            along = along[np.isfinite(along)]
            if len(along) == 0:
                value[frame] = np.nan
                continue
            value[frame] += opening.area(t) * float(along.mean())
            error[frame] = np.hypot(error[frame], opening.area(t) * float(along.std()) / np.sqrt(len(along)))
    return value, error


def _found(recording: Recording, motion: WallMotion, labels: list[int], phases: list[_Phase]) -> ValveTimes:
    """Intervals from nothing but the phases."""
    first, last = _ends(recording)
    rows, errors, changes = [], [], []
    if not phases:
        if len(labels) == 1:  # a cavity that keeps its volume passes nothing through a single opening
            return ValveTimes(np.zeros((0, 3)), np.zeros((0, 2)), "given")
        rows = [(label, first, last) for label in labels]
        text = f"the walls keep their volume: openings {labels} are taken for open all the time"
        return ValveTimes(np.array(rows), np.zeros((len(rows), 2)), "found", (text,))
    takers = _takers(recording, motion, labels, phases)
    for phase in phases:
        for label in sorted(takers[phase.sign]):
            rows.append((label, phase.start, phase.stop))
            errors.append((phase.start_error, phase.stop_error))
            sense = "fills" if phase.sign > 0 else "empties"
            changes.append(
                f"opening {label} is open from {phase.start:.4g} to {phase.stop:.4g} s (+- {phase.start_error:.2g}, "
                f"{phase.stop_error:.2g} s), while the cavity {sense}"
            )
    order = np.lexsort((np.array(rows)[:, 1], np.array(rows)[:, 0]))
    return ValveTimes(np.array(rows)[order], np.array(errors)[order], "found", tuple(changes))


def _corrected(
    recording: Recording, motion: WallMotion, labels: list[int], phases: list[_Phase], given: np.ndarray
) -> ValveTimes:
    """The given intervals, longer where the cavity's volume changes with every opening shut."""
    rows, error = np.array(given, np.float64), np.zeros((len(given), 2))
    present = np.isin(rows[:, 0], labels)
    # nothing is told more exactly than that between frames
    slack = 0.25 * float(np.diff(recording.time).min()) if recording.frames > 1 else 0.0
    changes = []
    takers = _takers(recording, motion, labels, phases) if phases else {}
    for phase in phases:
        mine = [k for k in range(len(rows)) if rows[k, 0] in takers[phase.sign]]
        inside = [k for k in mine if rows[k, 1] < phase.stop and rows[k, 2] > phase.start]
        early = phase.start + 2.0 * phase.start_error + slack
        late = phase.stop - 2.0 * phase.stop_error - slack
        open_at_start = any(rows[k, 1] <= early < rows[k, 2] for k in range(len(rows)) if present[k])
        open_at_stop = any(rows[k, 1] < late <= rows[k, 2] for k in range(len(rows)) if present[k])
        if not inside:
            continue  # an opening that is said to stay shut in this phase is left so: somebody knew why
        if not open_at_start:
            row = min(inside, key=lambda k: rows[k, 1])
            changes.append(_moved(rows[row], 1, phase.start))
            rows[row, 1], error[row, 0] = phase.start, phase.start_error
        if not open_at_stop:
            row = max(inside, key=lambda k: rows[k, 2])
            changes.append(_moved(rows[row], 2, phase.stop))
            rows[row, 2], error[row, 1] = phase.stop, phase.stop_error
    return ValveTimes(rows, error, "corrected" if changes else "given", tuple(changes))


def _moved(row: np.ndarray, column: int, time: float) -> str:
    event = "opens" if column == 1 else "closes"
    return (
        f"opening {int(row[0])} {event} at {time:.4g} s, not at {row[column]:.4g} s: the walls move volume while "
        "every opening is said to be shut"
    )
