"""What the data say about themselves: values that break no rule of the format, yet cannot be meant.

A finding names the dataset, what is odd about it with its numbers, and the cure. A severe one is refused
wherever a recording is read or written; the others are told by `torchsph info` and `convert`, and refused by
their `--strict`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from geometry.arguments import checked

from .errors import RecordingError
from .field_checks import axis_order, wrapped_speeds
from .finding import Finding
from .recording import Recording
from .rules import measured_nodes
from .wall_checks import bodies, fluxes, mask_and_wall, shells, volumes, wall_motion

LARGEST = 1.0  # m; hearts and vessels are smaller
SMALLEST = 1e-3  # m
LONGEST_PERIOD = 20.0  # s
LONGEST_INTERVAL = 5.0  # s
FAST = 8.0  # m/s; the fastest jets through narrow valves reach 6
VAGUE = 20.0  # m/s; an error beyond every speed says nothing
SENSELESS = 1e3  # m/s
CLOSED = 0.5  # share of measured nodes without any motion, above which it is told


@checked
def findings(recording: Recording, *, severe_only: bool = False) -> list[Finding]:
    """All that is odd about a recording, the severe findings first.

    Args:
        recording: one that keeps the rules of the format (`Recording.check`).
        severe_only: look only for what is refused, which is quick.
    """
    severe: tuple[Callable[[Recording], Iterator[Finding]], ...] = (_lengths, _times, _errors, bodies, mask_and_wall)
    others: tuple[Callable[[Recording], Iterator[Finding]], ...] = (
        _speeds,
        _fluid,
        _coverage,
        _regions,
        _valves,
        axis_order,
        wrapped_speeds,
        volumes,
        fluxes,
        wall_motion,
        shells,
    )
    found = [finding for check in (severe if severe_only else (*severe, *others)) for finding in check(recording)]
    kept = [finding for finding in found if finding.severe or not severe_only]
    return sorted(kept, key=lambda finding: not finding.severe)


def refuse_implausible(recording: Recording, source: str, *, strict: bool = False) -> None:
    """Raise RecordingError for the first severe finding, with `strict` for any finding."""
    for finding in findings(recording, severe_only=not strict):
        raise RecordingError(source, finding.dataset, finding.rule_and_cure)


def _lengths(recording: Recording) -> Iterator[Finding]:
    grid = recording.grid
    sizes = {"/grid": max(b - a for a, b in zip(grid.origin, grid.upper, strict=True))}
    if recording.wall is not None:
        lower, upper = recording.wall.at(0).bounds
        sizes["/wall/vertices"] = float((upper - lower).max())
    for dataset, size in sizes.items():
        if size > LARGEST:
            unit, scale = ("mm", 1e-3) if size > 10 * LARGEST else ("mm or cm", 1e-3)
            rule = f"is {size:.4g} m large, so it is probably in {unit}"
            yield Finding(dataset, rule, f"give all lengths in metres (mm times {scale:g})", severe=True)
        elif 0 < size < SMALLEST:
            yield Finding(dataset, f"is only {1e3 * size:.3g} mm large", "give all lengths in metres")


def _times(recording: Recording) -> Iterator[Finding]:
    cure = "give times in seconds (ms times 1e-3)"
    if recording.period > LONGEST_PERIOD:
        rule = f"is {recording.period:.4g} s, no beat of a heart; it is probably in ms"
        yield Finding("attribute period", rule, cure, severe=True)
    if recording.frames < 2:
        return
    interval = float(np.median(np.diff(recording.time)))
    if interval > LONGEST_INTERVAL:
        rule = f"frames are {interval:.4g} s apart, so they are probably in ms"
        yield Finding("/time", rule, cure, severe=True)
        return
    grid = recording.grid
    size = max(b - a for a, b in zip(grid.origin, grid.upper, strict=True))
    speed = _rms(recording.velocity[np.broadcast_to(measured_nodes(recording)[:, None], recording.velocity.shape)])
    if size > 0 and speed * interval > 2 * size:
        rule = f"at {speed:.3g} m/s blood passes the grid of {1e3 * size:.3g} mm {speed * interval / size:.2g} times "
        yield Finding("/time", f"{rule}between frames {interval:.3g} s apart", f"{cure}, or sample the beat more often")


def _errors(recording: Recording) -> Iterator[Finding]:
    if recording.sigma is None:
        return
    sigma = recording.sigma[np.broadcast_to(measured_nodes(recording)[:, None], recording.sigma.shape)]
    zero, highest = int((sigma == 0).sum()), float(sigma.max(initial=0))
    if zero and recording.uncovered is None:
        rule = f"is 0 for {zero} of {sigma.size} measured values, which claims that they are exact"
        cure = "give the standard deviation in m/s, or leave /sigma out"
        yield Finding("/sigma", rule, cure, severe=True)
    if highest > VAGUE:
        rule = f"reaches {highest:.3g} m/s, far above every speed"
        cure = "give m/s; where nothing is known, say so by /weight 0"
        yield Finding("/sigma", rule, cure, severe=highest > SENSELESS)


def _speeds(recording: Recording) -> Iterator[Finding]:
    speed = np.sqrt((recording.velocity.astype(np.float64) ** 2).sum(axis=1))[measured_nodes(recording)]
    highest = float(speed.max(initial=0))
    if highest > FAST:
        rule = f"reaches {highest:.3g} m/s (RMS {_rms(speed):.3g}), faster than the jets of narrow valves"
        yield Finding("/velocity", rule, "if it is in cm/s or mm/s, convert it to m/s; else mark outliers by /weight")
    elif 0 < highest < 1e-3:
        rule = f"stays below {1e3 * highest:.2g} mm/s"
        yield Finding("/velocity", rule, "give it in m/s (it may have been converted twice)")


def _fluid(recording: Recording) -> Iterator[Finding]:
    if not 500 < recording.rho < 2000:
        yield Finding("attribute rho", f"is {recording.rho:g} kg/m3; blood has 1060", "give kg/m3 (g/cm3 times 1000)")
    if recording.mu > 0.1:
        yield Finding("attribute mu", f"is {recording.mu:g} Pa s; blood has .004", "give Pa s (mPa s times 1e-3)")


def _coverage(recording: Recording) -> Iterator[Finding]:
    inside, measured = int(recording.mask.sum()), measured_nodes(recording)
    if inside == 0:
        yield Finding("/mask", "holds no node of blood at any frame", "give 1 inside the blood")
        return
    share = measured.sum() / inside
    if 0 < share < 0.2:  # a wall alone, in which nothing was measured, says so itself
        rule = f"only {100 * share:.2g} % of the nodes in the mask carry a measured value"
        yield Finding("/weight", rule, "look whether the mask and the weights belong together")
    frames = measured.reshape(recording.frames, -1).any(axis=1)
    still = measured & (recording.velocity == 0).all(axis=1)
    silent = frames & (still.sum(axis=tuple(range(1, still.ndim))) == measured.sum(axis=tuple(range(1, still.ndim))))
    if silent.any():
        rule = (
            f"is 0 everywhere in {int(silent.sum())} of {recording.frames} frames, the first of them {silent.argmax()}"
        )
        yield Finding("/velocity", rule, "leave frames without data out, or give them /weight 0")
    elif measured.any() and still.sum() > CLOSED * measured.sum():
        rule = f"is exactly 0 at {100 * still.sum() / measured.sum():.3g} % of the measured nodes"
        yield Finding("/velocity", rule, "take nodes without data out of /mask, or give them /weight 0")


def _regions(recording: Recording) -> Iterator[Finding]:
    wall = recording.wall
    if wall is None:
        return
    present = set(np.unique(wall.region).tolist())
    if 0 not in present:
        rule = f"says that every face is an opening (regions {', '.join(map(str, sorted(present)))})"
        yield Finding("/wall/region", rule, "give 0 to the faces of the wall itself")
    leak = () if recording.valve_leak is None else recording.valve_leak[:, 0].astype(int).tolist()
    named = [(flux.dataset, flux.region) for flux in recording.fluxes] + [("/valve/leak", region) for region in leak]
    for dataset, region in named:
        if region not in present:
            yield Finding(dataset, f"is of region {region}, of which the wall has no face", "label it in /wall/region")


def _valves(recording: Recording) -> Iterator[Finding]:
    intervals = recording.valve_intervals
    if intervals is None or len(intervals) == 0:
        return
    if recording.wall is not None:
        missing = sorted(set(intervals[:, 0].astype(int).tolist()) - set(np.unique(recording.wall.region).tolist()))
        if missing:
            rule = f"names region {', '.join(map(str, missing))}, of which the wall has no face"
            yield Finding("/valve/intervals", rule, "label the faces of each orifice in /wall/region")
    first, last = recording.time[0], recording.time[-1]
    opens, closes = intervals[:, 1], intervals[:, 2]
    if recording.period > 0:
        odd = closes - opens > recording.period * (1 + 1e-9)
        rule, span = "longer than the period", f"the period is {recording.period:g} s"
    else:
        odd = np.maximum(opens - last, first - closes) > max(last - first, 1.0)
        rule, span = "far from every frame", f"frames run from {first:g} to {last:g} s"
    if odd.any():
        region, start, end = intervals[int(odd.argmax())]
        said = f"region {int(region)} is open from {start:g} to {end:g} s, {rule}"
        yield Finding("/valve/intervals", said, f"{span}: give both in seconds from the same start")


def _rms(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)].astype(np.float64)
    return float(np.sqrt(np.mean(finite**2))) if finite.size else 0.0
