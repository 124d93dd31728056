"""The ensemble filter over a recording: forecast control and members, analyse each frame, learn, go on."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import geometry
import regularize
from torchsph.assimilation import LETKF, RTPS, Filter, Localisation
from torchsph.simulator.simulator import Simulator

from ..frame_splines import FrameSmoother, smooth_frames
from ..measurement.error_model import ObservationError, estimate_error
from ..measurement.observation_operator import Source
from ..runtime import checkpoint
from .cycle import Cycle
from .forecaster import Forecaster
from .options import EnsembleOptions

# a deviation of the observation errors this many times the stated one is worth a warning
_NOISY = 2.0


@dataclass(frozen=True)
class EnsembleRun:
    """The analyses of a recording, with the standard deviation the filter claims, and the accounts."""

    recording: geometry.Recording
    info: dict[str, Any] = field(default_factory=dict)


def default_filter(measured: geometry.Recording, options: EnsembleOptions) -> LETKF:
    """Local ensemble transform Kalman filter with RTPS, its radius from the size of the walls."""
    vertices = measured.wall_for("the ensemble").at(0).vertices
    radius = options.localisation * float(np.ptp(vertices, axis=0).max())
    return LETKF(localisation=Localisation(radius), inflation=RTPS(options.relaxation), gross_error=options.gross_error)


def assimilate(
    measured: geometry.Recording,
    model: Simulator,
    *,
    members: int = 16,
    filter: Filter | None = None,
    options: EnsembleOptions | None = None,
    coarse: Simulator | None = None,
    also: Sequence[geometry.Recording] = (),
    splines: FrameSmoother | None = None,
    smoothed: geometry.Recording | None = None,
    error: ObservationError | None = None,
    truth: geometry.Recording | None = None,
    checkpoints: str | Path | None = None,
    resume: bool = False,
    seed: int = 0,
    progress: bool = False,
) -> EnsembleRun:
    """Assimilate measurements into an ensemble of SPH simulations.

    The first frame's spline is the control, draws from its posterior make the members. Every cycle imposes the grids
    on particles, advances the control in ``model`` and the members in ``coarse`` to the next frame and fetches the
    grids. What the measurement would see of them (blurred by its kernel, on its grid, along its beam) is compared with
    what it saw, and two analyses of the difference are made: a penalised spline of the innovations and a localised
    ensemble filter. How far each is followed is learned from whether the next innovations are still correlated with
    it (``LearnedGain``); how large the spread must be, from what the analysis took over (``SpreadMatch``); how wrong
    the observations are, from what is left (``ErrorScale``).

    Args:
        measured: its grid, mask, walls and times are those of the analysis. model: simulator of its scene.
        members: at least 2.
        filter: any ``torchsph.assimilation`` filter; None takes ``default_filter``.
        coarse: simulator of the members; None: ``model``.
        also: further measurements of the same beat, each with its own grid, times and errors; a frame is compared with
            the forecast at its own time and enters the next analysis.
        splines: of ``measured``; smoothed: their result; error: its error model; where they are there already.
        truth: for the scores in the record alone. It never enters an analysis.
        checkpoints: file to which every cycle writes its state. resume: go on from it where it is there.
        seed: of everything random. Under ``torch.distributed`` the processes share the simulations; the result is the
            same for any number of them.

    Raises:
        ValueError: fewer than two members, or a checkpoint of another run. NumericalFailure: all simulations failed.
    """
    if members < 2:
        raise ValueError(f"an ensemble needs at least 2 members, got {members}")
    if resume and checkpoints is None:
        raise ValueError("resume needs the file of checkpoints that the run before wrote")
    options = EnsembleOptions() if options is None else options
    coarse = model if coarse is None else coarse
    filter = default_filter(measured, options) if filter is None else filter
    splines = FrameSmoother(measured, regularize.Smoother()) if splines is None else splines
    if error is None:
        error = estimate_error(measured, splines, smooth_frames(splines, progress) if smoothed is None else smoothed)
    sources = [Source(measured, error, measured.grid, options.kernel)]
    sources += [_other(one, measured, options, progress) for one in also]
    cycle = Cycle(
        sources,
        splines,
        Forecaster(model, coarse, measured.grid, options.transfer, batch=options.batch, seed=seed),
        filter,
        options,
        members=members,
        usual=_usual_speed(measured, splines, smoothed),
        truth=truth,
        seed=seed,
    )
    key = checkpoint.fingerprint(_identity(measured, also, model, coarse, filter, options, members, seed))
    path = None if checkpoints is None else Path(checkpoints)
    state = checkpoint.load(path, key) if resume else None
    if state is not None:
        cycle.restore(state)
    _run(cycle, path, key, progress)
    return EnsembleRun(_as_recording(cycle), _accounts(cycle))


def _run(cycle: Cycle, path: Path | None, key: str, progress: bool) -> None:
    frames = range(cycle.done, cycle.measured.frames)
    for frame in tqdm(frames, desc="ensemble", unit="frame", disable=None if progress else True):
        if frame == 0:
            cycle.begin()
        else:
            cycle.step(frame)
        if path is not None:
            checkpoint.save(path, key, cycle.state())


def _other(
    recording: geometry.Recording, measured: geometry.Recording, options: EnsembleOptions, progress: bool
) -> Source:
    """A further measurement with its own error model, for the state of the first."""
    if recording.dimension != measured.dimension:
        raise ValueError(
            f"a further measurement has {recording.dimension} dimensions, the first one {measured.dimension}"
        )
    splines = FrameSmoother(recording, regularize.Smoother())
    error = estimate_error(recording, splines, smooth_frames(splines, progress))
    return Source(recording, error, measured.grid, options.kernel)


def _usual_speed(measured: geometry.Recording, splines: FrameSmoother, smoothed: geometry.Recording | None) -> float:
    """RMS per component of the splines, m/s; without them, of some of the frames'."""
    if smoothed is None:
        chosen = [f for f in range(0, measured.frames, 4) if splines.measures(f)]
        parts = [splines.on_grid(splines.fit(f), f)[:, np.array(measured.mask[f], bool)] for f in chosen]
        inside = np.concatenate(parts, 1) if parts else np.zeros(1)
    else:
        inside = np.moveaxis(smoothed.velocity, 1, -1)[np.asarray(measured.mask, bool)]
    return float(np.sqrt(np.mean(np.square(inside, dtype=np.float64))))


def _identity(
    measured: geometry.Recording,
    also: Sequence[geometry.Recording],
    model: Simulator,
    coarse: Simulator,
    filter_: Filter,
    options: EnsembleOptions,
    members: int,
    seed: int,
) -> list[object]:
    """What must be the same for a run to go on where another stopped."""
    simulators = [(one.scene.spacing, one.scheme, one.dtype, one.seeding) for one in (model, coarse)]
    arrays = [array for recording in (measured, *also) for array in recording.arrays().values()]
    return [simulators, filter_, options, members, seed, *arrays]


def _as_recording(cycle: Cycle) -> geometry.Recording:
    return cycle.measured.with_velocity(
        np.stack([field.numpy() for field in cycle.fields]),
        sigma=np.stack([sigma.numpy() for sigma in cycle.sigmas]),
        uncovered=np.array(cycle.missing, np.int64),
        description=f"ensemble of {cycle.count} SPH simulations",
    )


def _accounts(cycle: Cycle) -> dict[str, Any]:
    """What a metrics file says of the run."""
    shape = (len(cycle.options.increments), cycle.grid.dimension)
    weights = cycle.gain.weight.reshape(shape).tolist()
    replaced = sum(1 for event in cycle.events if "failed" in event)
    learned = {
        name: {"mean": float(row.mean()), "deviation": float(row.std())}
        for name, row in cycle.ensemble.parameters.items()
    }
    kept = cycle.record.summary()
    kept["warnings"] = kept["warnings"] + _noisier(cycle)
    return {
        "members": cycle.count,
        "replaced_members": replaced,
        "events": cycle.events,
        "shocks": _shocks(cycle),
        "divergence_not_converged": _divergent(cycle),
        "coasted_frames": sum(1 for event in cycle.events if "coasted" in event),
        "gain": dict(zip(cycle.options.increments, weights, strict=True)),
        "spread_factor": cycle.spread.factor,
        "observation_error_scale": cycle.scale.factor.tolist(),
        "kernel": [one.kernel for one in cycle.sources],
        "estimated": learned,
        "filter": kept,
        "options": repr(cycle.options),
    }


def _divergent(cycle: Cycle) -> int:
    """The number of analyses whose divergence was not removed as asked for; warns of them."""
    left = [event["divergence_left"] for event in cycle.events if "divergence_left" in event]
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
    words = []
    for number, (source, first) in enumerate(zip(cycle.sources, cycle.first_group, strict=False)):
        name = "the measurement" if number == 0 else f"further measurement {number}"
        for part in range(source.groups):
            times = float(cycle.scale.factor[first + part]) ** 0.5
            what = "" if source.groups == 1 else f" in {'xyz'[part]}"
            if times > _NOISY:
                words.append(
                    f"{name} is {times:.2g} times as noisy{what} as its errors say; it was trusted that much less"
                )
    return words


def _shocks(cycle: Cycle) -> list[dict[str, float | None]]:
    """How abrupt each analysis was for the particles that took it up: the part of their velocities that they lost.

    It is what was divergent, or went through a wall: RMS, relative to the flow's. None where a scheme does not project.
    """
    starts = cycle.measured.time[: len(cycle.shocks)].tolist()
    return [
        {"time": time, "shock": shock if math.isfinite(shock) else None}
        for time, shock in zip(starts, cycle.shocks, strict=True)
    ]
