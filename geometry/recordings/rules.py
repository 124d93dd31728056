"""The rules of the recording file, each with a message that names the dataset, the rule broken and the cure.

A rule is stated once, here, and holds for a recording that was read as well as for one about to be written. Ranks and
sizes that must agree are invariants of the class (`Recording`), which refuses to be built otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from geometry.arguments import checked
from geometry.surfaces.surface import SurfaceError

from .errors import RecordingError
from .recording import RULES, Recording

MOST = 1e6  # m3 or m3/s: beyond it, numbers are no volumes in any unit
FASTEST = 20.0  # m/s; blood never is as fast, so larger numbers are mm/s or cm/s

# Far beyond every flow that somebody measures; numbers outside would run out of memory, time or floating-point range.
LONGEST = 1e3  # m
FINEST = 1e-9  # m
LATEST = 1e10  # s; seconds since 1970 are below
SHORTEST_PERIOD = 1e-3  # s
MOST_PERIODS = 10_000
MOST_INTERVALS = 1_000  # a valve opens about once a beat
DENSITIES = (1e-3, 1e6)  # kg/m^3
STICKIEST = 1e6  # Pa s
STRAY = 10.0  # sizes of the surface at most, by which vertices that no face uses may widen its box


@checked
def check_recording(recording: Recording, source: str = "recording") -> None:
    """Hold a recording against every rule of the format.

    Args:
        recording: in memory, its shapes agreeing as the class asks.
        source: say the file; it opens the message.

    Raises:
        RecordingError: the first rule that is broken.
    """
    for rule in (
        _constants,
        _description,
        _cut,
        _grid,
        _time,
        _weight,
        _finite,
        _wall,
        _speed,
        _sigma,
        _beam,
        _normal,
        _nyquist,
        _overlap,
        _valves,
        _series,
    ):
        rule(recording, source)


RULES.append(check_recording)


def measured_nodes(recording: Recording) -> np.ndarray:
    """Nodes `(T, *shape)` that carry a value: inside the mask and not of weight 0."""
    return recording.mask if recording.weight is None else recording.mask & (recording.weight > 0)


def _constants(recording: Recording, source: str) -> None:
    low, high = DENSITIES
    if not low <= recording.rho <= high:
        rule = f"must be a positive density in kg/m^3, from {low:g} to {high:g}, not {recording.rho}"
        raise RecordingError(source, "attribute rho", rule)
    for name, most, unit in (("mu", STICKIEST, "Pa s"), ("period", LATEST, "s; 0 = not periodic")):
        value = getattr(recording, name)
        if not 0 <= value <= most:
            rule = f"must be finite and not negative ({unit}), at most {most:g}, not {value}"
            raise RecordingError(source, f"attribute {name}", rule)
    if 0 < recording.period < SHORTEST_PERIOD:
        rule = f"is {recording.period:g} s, shorter than every beat; give it in seconds, or 0 where nothing repeats"
        raise RecordingError(source, "attribute period", rule)


def _description(recording: Recording, source: str) -> None:
    text = recording.description
    if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
        rule = "must be plain text without NUL and without halves of surrogate pairs; leave out what is not text"
        raise RecordingError(source, "attribute description", rule)


def _cut(recording: Recording, source: str) -> None:
    if recording.cut and recording.dimension != 2:
        raise RecordingError(
            source, "attribute cut", "is 1, for a plane cut out of a flow in space, but this is a volume"
        )


def _grid(recording: Recording, source: str) -> None:
    grid = recording.grid
    if min(grid.spacing) < FINEST or max(grid.spacing) > LONGEST:
        rule = f"spacing must lie between {FINEST:g} and {LONGEST:g} m, not {grid.spacing}; give it in metres"
        raise RecordingError(source, "/grid", rule)
    if max(abs(end) for end in (*grid.origin, *grid.upper)) > LONGEST:
        rule = f"the box {_box(grid.origin, grid.upper)} lies farther than {LONGEST:g} m from 0; give it in metres"
        raise RecordingError(source, "/grid", rule)


def _time(recording: Recording, source: str) -> None:
    time = recording.time
    if not np.isfinite(time).all():
        raise RecordingError(source, "/time", "must be finite, in seconds")
    if np.abs(time).max() > LATEST:
        rule = f"reaches {np.abs(time).max():g} s, farther than {LATEST:g} s from 0; give seconds"
        raise RecordingError(source, "/time", rule)
    falling = np.diff(time) <= 0
    if falling.any():
        frame = int(np.argmax(falling))
        rule = f"must increase strictly, but frame {frame} at {time[frame]:g} s precedes {time[frame + 1]:g} s"
        raise RecordingError(source, "/time", f"{rule}; sort the frames and drop repeated ones")
    if time[-1] - time[0] > MOST_PERIODS * recording.period > 0:
        rule = f"is {recording.period:g} s, of which the frames span more than {MOST_PERIODS}; give both in seconds"
        raise RecordingError(source, "attribute period", rule)


def _weight(recording: Recording, source: str) -> None:
    if recording.weight is None:
        return
    bad = ~((recording.weight >= 0) & (recording.weight <= 1))  # written so that NaN is bad as well
    if bad.any():
        rule = f"must lie in [0, 1], but is {recording.weight[bad][0]:g} at {_first(bad)}"
        raise RecordingError(source, "/weight", f"{rule}; rescale it, and use 0 where nothing was measured")


def _finite(recording: Recording, source: str) -> None:
    measured, components = measured_nodes(recording), -1 - recording.dimension
    for dataset in ("/velocity", "/sigma", "/beam", "/normal", "/pressure", "/pressure_sigma"):
        field = recording.arrays().get(dataset)
        if field is None:
            continue
        finite = np.isfinite(field) if dataset.startswith("/pressure") else np.isfinite(field).all(axis=components)
        bad = measured & ~finite
        if bad.any():
            rule = f"must be finite inside the mask, but is not at {int(bad.sum())} nodes, as at {_first(bad)}"
            raise RecordingError(source, dataset, f"{rule}; take them out of /mask or give them /weight 0")


def _speed(recording: Recording, source: str) -> None:
    with np.errstate(invalid="ignore", over="ignore"):
        speed = np.sqrt((recording.velocity.astype(np.float64) ** 2).sum(axis=1))
        wall = None if recording.wall is None else recording.wall.velocity
        moving = np.zeros(0) if wall is None else np.sqrt((wall.astype(np.float64) ** 2).sum(axis=-1))
    inside = speed[measured_nodes(recording)]
    for dataset, values in (("/velocity", inside), ("/wall/velocity", moving)):
        if values.size and not values.max() <= FASTEST:
            rule = f"reaches {values.max():g}, above {FASTEST:g} m/s, so it is probably in mm/s or cm/s"
            raise RecordingError(source, dataset, f"{rule}; convert it to m/s")


def _sigma(recording: Recording, source: str) -> None:
    if recording.sigma is None:
        return
    bad = (recording.sigma < 0).any(axis=1) & measured_nodes(recording)
    if bad.any():
        rule = f"is a standard deviation in m/s and must not be negative, as at {_first(bad)}"
        raise RecordingError(source, "/sigma", rule)


def _beam(recording: Recording, source: str) -> None:
    if recording.beam is not None:
        _unit_vectors(recording, recording.beam, source, "/beam")


def _normal(recording: Recording, source: str) -> None:
    if recording.normal is None:
        return
    if recording.dimension != 3 or recording.beam is not None or recording.nyquist is not None:
        rule = "is of planes in space that hold both components in the plane, neither wrapped nor along a beam"
        raise RecordingError(source, "/normal", f"{rule}; leave out /normal, /beam or /nyquist")
    _unit_vectors(recording, recording.normal, source, "/normal")


def _unit_vectors(recording: Recording, field: np.ndarray, source: str, dataset: str) -> None:
    length = np.sqrt((field.astype(np.float64) ** 2).sum(axis=-1 - recording.dimension))
    bad = measured_nodes(recording) & (np.abs(length - 1) > 1e-3)
    if bad.any():
        rule = f"must hold unit vectors, but does not at {_first(bad)}; divide by their length"
        raise RecordingError(source, dataset, rule)


def _nyquist(recording: Recording, source: str) -> None:
    limit = recording.nyquist
    if limit is not None and not ((limit > 0) & (limit <= FASTEST)).all():
        rule = f"is the speed at which a measurement wraps, m/s: positive and at most {FASTEST:g}, not {limit.min():g}"
        raise RecordingError(source, "/nyquist", f"{rule}; leave it out where nothing wraps")


def _wall(recording: Recording, source: str) -> None:
    wall = recording.wall
    if wall is None:
        return
    for dataset, values in (("/wall/vertices", wall.vertices), ("/wall/velocity", wall.velocity)):
        if values is not None and not np.isfinite(values).all():
            raise RecordingError(source, dataset, "must be finite everywhere")
    if wall.vertices.size and np.abs(wall.vertices).max() > LONGEST:
        rule = f"reaches {np.abs(wall.vertices).max():g} m, farther than {LONGEST:g} m from 0; give it in metres"
        raise RecordingError(source, "/wall/vertices", rule)
    if wall.sigma is not None and not ((wall.sigma >= 0) & (wall.sigma <= LONGEST)).all():
        rule = "is the standard deviation of a vertex's place in m: finite, and not negative"
        raise RecordingError(source, "/wall/sigma", rule)
    if len(wall.faces) == 0:
        raise RecordingError(source, "/wall/faces", "holds no face, so there is no surface around the blood")
    try:
        first = wall.at(0)
        first.check()
    except SurfaceError as fault:
        raise RecordingError(source, "/wall/faces", str(fault)) from fault
    used = wall.vertices[..., np.unique(wall.faces), :]
    size, widened = (np.ptp(part, axis=-2).max() for part in (used, wall.vertices))
    if widened > (1 + STRAY) * size:
        rule = f"vertices that no face uses lie up to {widened:.3g} m away from a surface of {size:.3g} m; remove them"
        raise RecordingError(source, "/wall/vertices", rule)
    # Closedness is a matter of the faces alone; only the orientation may change in later frames.
    sense = np.sign(first.component_volumes)
    for frame in range(1, recording.frames if wall.moves else 1):
        surface = first.moved(wall.vertices[frame])
        if (np.sign(surface.component_volumes) != sense).any():
            rule = f"the surface is inside out at frame {frame}, but not at frame 0"
            raise RecordingError(source, "/wall/vertices", rule)


def _overlap(recording: Recording, source: str) -> None:
    if recording.wall is None:
        return
    used = recording.wall.vertices[..., np.unique(recording.wall.faces), :].reshape(-1, recording.dimension)
    lower, upper = used.min(axis=0), used.max(axis=0)
    grid = recording.grid
    if (np.asarray(grid.origin) > upper).any() or (np.asarray(grid.upper) < lower).any():
        rule = f"the box {_box(grid.origin, grid.upper)} does not overlap the wall's box {_box(lower, upper)}"
        raise RecordingError(source, "/grid", f"{rule}; give both in metres in the same coordinates")


def _valves(recording: Recording, source: str) -> None:
    intervals = recording.valve_intervals
    if intervals is not None:
        if len(intervals) > MOST_INTERVALS:
            rule = f"holds {len(intervals)} rows, more than {MOST_INTERVALS}; a valve opens about once a beat"
            raise RecordingError(source, "/valve/intervals", f"{rule}: give a row for each time, or one beat's")
        if not np.isfinite(intervals).all():
            raise RecordingError(source, "/valve/intervals", "must be finite: rows (region label, opens, closes)")
        if np.abs(intervals[:, 1:]).max(initial=0) > LATEST:
            raise RecordingError(source, "/valve/intervals", f"times must lie within {LATEST:g} s from 0; give seconds")
        label = intervals[:, 0]
        if ((label != np.rint(label)) | (label < 1)).any():
            rule = f"its first column must hold region labels 1, 2, ..., not {label}"
            raise RecordingError(source, "/valve/intervals", rule)
        if (intervals[:, 2] <= intervals[:, 1]).any():
            rule = "a valve must close after it opens: rows (region label, opening time, closing time)"
            raise RecordingError(source, "/valve/intervals", rule)
    if recording.valve_open is not None and (recording.valve_open > 1).any():
        raise RecordingError(source, "/valve_open", "must hold 0 (closed) and 1 (open) only")
    if recording.valve_leak is not None:
        _leak(recording.valve_leak, source)


def _leak(leak: np.ndarray, source: str) -> None:
    label, part = leak.T
    if not ((label == np.rint(label)) & (label >= 1)).all() or len(np.unique(label)) < len(label):
        rule = f"its first column must hold region labels 1, 2, ..., each once, not {label}"
        raise RecordingError(source, "/valve/leak", rule)
    if not ((part >= 0) & (part < 1)).all():
        rule = f"must hold the part of a shut valve's area that stays open, from 0 to below 1, not {part}"
        raise RecordingError(source, "/valve/leak", rule)


def _series(recording: Recording, source: str) -> None:
    for dataset in ("/volume", "/flux/mitral", "/flux/aortic"):
        values = recording.arrays().get(dataset)
        if values is not None and not np.isfinite(values).all():
            raise RecordingError(source, dataset, "must be finite at every frame")
        if values is not None and values.size and np.abs(values).max() > MOST:
            unit = "m3" if dataset == "/volume" else "m3/s"
            rule = f"reaches {np.abs(values).max():g} {unit}, which no heart holds or moves"
            raise RecordingError(source, dataset, f"{rule}; give {unit} (ml times 1e-6), or leave it out")
    for flux in recording.fluxes:
        flux.check(source)
    if recording.uncovered is not None and (recording.uncovered < 0).any():
        raise RecordingError(source, "/uncovered", "counts nodes and must not be negative")


def _first(bad: np.ndarray) -> str:
    frame, *node = (int(number) for number in np.argwhere(bad)[0])
    return f"frame {frame}, node {tuple(node)} (array order)"


def _box(lower: Iterable[float], upper: Iterable[float]) -> str:
    return " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(lower, upper, strict=True)) + " m"
