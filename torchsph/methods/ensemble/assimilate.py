"""The ensemble filter over a recording: forecast control and members, analyse each frame, learn, go on.

The first frame's spline is the control, draws from its posterior make the members. Every cycle imposes the grids on
particles, advances the control in ``model`` and the members in ``coarse`` to the next frame and fetches the grids. What
the measurement would see of them (blurred by its kernel, on its grid, along its beam) is compared with what it saw, and
two analyses of the difference are made: a penalised spline of the innovations and a localised ensemble filter. How far
each is followed is learned from whether the next innovations are still correlated with it (``LearnedGain``); how large
the spread must be, from what the analysis took over (``SpreadMatch``); how wrong the observations are, from what is
left (``ErrorScale``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

import geometry
from geometry.arguments import between, checked
from torchsph.assimilation import LETKF, RTPS, Filter, Localisation
from torchsph.simulator.simulator import Simulator
from torchsph.simulator.state.checks import MOST_MEMBERS
from torchsph.simulator.transfer.checks import check_grid

from ..between_frames import BetweenFrames, FlowAt
from ..measurement.observation_operator import Measurement
from ..measurement.prepared import PreparedMeasurement
from ..members.frames import FrameObserver
from ..runtime import checkpoint
from ..runtime.checkpoint import Saved
from ..runtime.parallel import anywhere
from ..runtime.watching import FrameDone, Stopped, Watcher
from .accounts import accounts_of
from .cycle import Cycle
from .forecaster import Forecaster
from .identity import ensemble_key
from .options import EnsembleOptions


@dataclass(frozen=True)
class EnsembleRun:
    """The analyses of a recording, with the standard deviation the filter claims, and the accounts.

    Attributes:
        recording: the analyses.
        info: the accounts.
        model: simulator of the control, which `at` asks what lies between the frames.
    """

    recording: geometry.Recording
    info: dict[str, Any] = field(default_factory=dict)
    model: Simulator | None = None

    def at(self, times: ArrayLike, points: ArrayLike) -> FlowAt:
        """Velocity and deviation at any times (s) and points (n, D), m, between the frames as the model has it."""
        return BetweenFrames(self.recording, self.model).at(times, points)


@checked
def default_filter(measured: geometry.Recording, options: EnsembleOptions) -> LETKF:
    """Local ensemble transform Kalman filter with RTPS, its radius from the size of the walls."""
    vertices = measured.wall_for("the ensemble").at(0).vertices
    radius = options.localisation * float(np.ptp(vertices, axis=0).max())
    return LETKF(localisation=Localisation(radius), inflation=RTPS(options.relaxation), gross_error=options.gross_error)


@checked(members=between(1, MOST_MEMBERS))
def assimilate(
    measured: geometry.Recording | PreparedMeasurement,
    model: Simulator,
    *,
    members: int = 16,
    filter: Filter | None = None,
    options: EnsembleOptions | None = None,
    coarse: Simulator | None = None,
    also: Sequence[geometry.Recording | PreparedMeasurement] = (),
    truth: geometry.Recording | None = None,
    checkpoints: str | Path | None = None,
    resume: bool | Saved = False,
    watcher: Watcher | None = None,
    seed: int = 0,
    progress: bool = False,
    observers: Sequence[FrameObserver] = (),
) -> EnsembleRun:
    """Assimilate measurements into an ensemble of SPH simulations, as this module's docstring says.

    Args:
        measured: a recording, prepared or not; its grid, mask, walls and times are those of the analysis.
        model: simulator of its scene.
        members: at least 2.
        filter: any ``torchsph.assimilation`` filter; None takes ``default_filter``.
        coarse: simulator of the members; None: ``model``.
        also: further measurements of the same beat, each with its own grid, times and errors; a frame is compared with
            the forecast at its own time and enters the next analysis.
        truth: for the scores in the record alone. It never enters an analysis.
        checkpoints: file to which every cycle writes its state.
        resume: go on from it where it is there; or the checkpoint itself, where it was read already.
        watcher: is told of every frame, and may ask the run to stop; one process has it, or several.
        seed: of everything random. Under ``torch.distributed`` the processes share the simulations; the result is the
            same for any number of them.
        progress: show a bar.
        observers: what is done with every frame, its members and accelerations, as the first process has them; not
            with a lag, which changes analyses after their time.

    Returns:
        The analyses, with their claimed deviation and the accounts of the run.

    Raises:
        ValueError: fewer than two members, a simulator or a truth of another grid than the measurement's, or a
            checkpoint of another run.
        NumericalFailure: all simulations failed, or fewer are alive than ``options.minimum_members``.
        Stopped: the watcher asked for it; the checkpoint holds all frames that were done.
    """
    if members < 2:
        raise ValueError(f"an ensemble needs at least 2 members, got {members}")
    if resume and checkpoints is None:
        raise ValueError("resume needs the file of checkpoints that the run before wrote")
    options = EnsembleOptions() if options is None else options
    if observers and options.lag is not None:
        raise ValueError(
            "members are followed without a lag alone: later data change the analyses that they lie around"
        )
    coarse = model if coarse is None else coarse
    given = measured if isinstance(measured, geometry.Recording) else measured.recording
    for one in (model, coarse):
        check_grid(given.grid, one.scene.dimension)
    if truth is not None and truth.grid.shape != given.grid.shape:
        raise ValueError(f"the truth has a grid of {truth.grid.shape} nodes, the measurement one of {given.grid.shape}")
    first = PreparedMeasurement.of(measured, progress=progress)
    prepared = [first, *(further(other, first) for other in also)]
    grid = first.recording.grid
    filter = default_filter(first.recording, options) if filter is None else filter
    key = ensemble_key(prepared, model, coarse, filter, options, members=members, seed=seed, truth=truth)
    path = None if checkpoints is None else Path(checkpoints)
    saved = resume if isinstance(resume, Saved) else None
    if resume is True and path is not None:
        saved = Saved.read(path)
    if saved is not None:
        saved.refuse_foreign(key)  # before the splines and error models that the cycle begins with
    cycle = Cycle(
        [Measurement(each, grid, options.kernel) for each in prepared],
        Forecaster(model, coarse, grid, options.transfer, batch=options.batch, seed=seed, motion=bool(observers)),
        filter,
        options,
        members=members,
        truth=truth,
        seed=seed,
        observers=observers,
    )
    state = checkpoint.shared_state(saved, key) if resume else None
    if state is not None:
        cycle.restore(state)
    _run(cycle, path, key, progress, watcher)
    return EnsembleRun(cycle.analyses.recording(f"ensemble of {members} SPH simulations"), accounts_of(cycle), model)


def _run(cycle: Cycle, path: Path | None, key: str, progress: bool, watcher: Watcher | None) -> None:
    count = cycle.measured.frames
    if watcher is not None:
        watcher.begins()
    for frame in tqdm(range(cycle.done, count), desc="ensemble", unit="frame", disable=None if progress else True):
        if frame == 0:
            cycle.begin()
        else:
            cycle.step(frame)
        if path is not None:
            checkpoint.save(path, key, cycle.state())
        if watcher is not None:
            watcher.frame_done(FrameDone(frame, count, cycle.alive, cycle.count))
        if anywhere(watcher is not None and watcher.asked_to_stop()) and frame + 1 < count:
            raise Stopped(f"stopped after frame {frame + 1} of {count}")


def further(also: geometry.Recording | PreparedMeasurement, first: PreparedMeasurement) -> PreparedMeasurement:
    """A further measurement with its own error model, for the state of the first."""
    prepared = PreparedMeasurement.of(also, progress=first.progress)
    dimension, wanted = prepared.recording.dimension, first.recording.dimension
    if dimension != wanted:
        raise ValueError(f"a further measurement has {dimension} dimensions, the first one {wanted}")
    return prepared
