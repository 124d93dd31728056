"""What a finished run of the ensemble says of itself, in plain numbers and words."""

from __future__ import annotations

import math
import warnings
from typing import Any

from ..measurement.observation_batch import error_groups
from .cycle import Cycle

# a deviation of the observation errors this many times the stated one is worth a warning
_NOISY = 2.0


def accounts_of(cycle: Cycle) -> dict[str, Any]:
    """What a metrics file says of the run."""
    shape = (len(cycle.options.increments), cycle.grid.dimension)
    weights = cycle.analyser.gain.weight.reshape(shape).tolist()
    replaced = sum(1 for event in cycle.analyses.events if "failed" in event)
    learned = {
        name: {"mean": float(row.mean()), "deviation": float(row.std())}
        for name, row in cycle.ensemble.parameters.items()
    }
    kept = cycle.analyser.record.summary()
    kept["warnings"] = kept["warnings"] + _noisier(cycle)
    return {
        "members": cycle.count,
        "replaced_members": replaced,
        "events": cycle.analyses.events,
        "shocks": _shocks(cycle),
        "divergence_not_converged": _divergent(cycle),
        "coasted_frames": sum(1 for event in cycle.analyses.events if "coasted" in event),
        "gain": dict(zip(cycle.options.increments, weights, strict=True)),
        "spread_factor": cycle.analyser.spread_match.factor,
        "observation_error_scale": cycle.analyser.scale.factor.tolist(),
        "kernel": [measurement.kernel for measurement in cycle.measurements],
        "amplitude_error": _amplitude_error(cycle),
        "estimated": learned,
        "filter": kept,
        "options": repr(cycle.options),
    }


def _amplitude_error(cycle: Cycle) -> float | None:
    """The deviation of the members' amplitudes, relative; None where nobody looks at members."""
    return None if cycle.member_frames is None else cycle.measurements[0].prepared.amplitude_error


def _divergent(cycle: Cycle) -> int:
    """The number of analyses whose divergence was not removed as asked for; warns of them."""
    left = [event["divergence_left"] for event in cycle.analyses.events if "divergence_left" in event]
    if left:
        warnings.warn(
            f"removing the divergence did not converge in {len(left)} analyses (of the divergence up to "
            f"{max(left):.2g} is left); 1 means that the field was left alone",
            RuntimeWarning,
            stacklevel=4,
        )
    return len(left)


def _noisier(cycle: Cycle) -> list[str]:
    """In words, which components of which measurements are far noisier than their error models say."""
    words, groups = [], error_groups(cycle.measurements)
    for number, (measurement, first) in enumerate(zip(cycle.measurements, groups[:-1], strict=True)):
        name = "the measurement" if number == 0 else f"further measurement {number}"
        for part in range(measurement.type.parts):
            times = float(cycle.analyser.scale.factor[first + part]) ** 0.5
            what = "" if measurement.type.parts == 1 else f" in {'xyz'[part]}"
            if times > _NOISY:
                words.append(
                    f"{name} is {times:.2g} times as noisy{what} as its errors say; it was trusted that much less"
                )
    return words


def _shocks(cycle: Cycle) -> list[dict[str, float | None]]:
    """How abrupt each analysis was for the particles that took it up: the part of their velocities that they lost.

    It is what was divergent, or went through a wall: RMS, relative to the flow's. None where a scheme does not project.
    """
    starts = cycle.measured.time[: len(cycle.analyses.shocks)].tolist()
    return [
        {"time": time, "shock": shock if math.isfinite(shock) else None}
        for time, shock in zip(starts, cycle.analyses.shocks, strict=True)
    ]
