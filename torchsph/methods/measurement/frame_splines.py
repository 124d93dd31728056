"""The rival: a penalised B-spline field for each frame of a measurement."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import geometry
import regularize
from geometry.arguments import between, checked
from regularize.options import BY_DATA, CURVATURE
from regularize.solvers.factor import Factor

from ..runtime.parallel import advanced, shared
from ..runtime.workers import MOST_WORKERS, chosen_workers, spread
from .flux_data import with_fluxes
from .informative import refuse_exact, refuse_silent
from .unwrapping import unwrapped
from .wall_rows import at_knots, mean_certainty, open_together, wall_rows
from .wall_trust import wall_trust

# noise and smoothness are chosen in every third frame and serve its neighbours: flow and noise change over tens of
# milliseconds, and a choice costs four times a fit
CHOICE_EVERY = 3
# strength of the divergence's penalty in a plane cut out of a flow, in knot distances, sqrt(2) times smoothness's: in
# isotropic turbulence without divergence <(du/dx + dv/dy)^2> in a plane is a third of what independent components
# with the same <|grad v|^2> have (Taylor 1935); at the scale that smoothness cuts off
# two thirds of it are held back so
OF_A_CUT = 2**0.5 / CURVATURE


def node_weights(recording: geometry.Recording, frame: int) -> np.ndarray:
    """Confidence (*shape) of a frame's nodes: its weight, or one, inside the mask; 0 where the velocity is missing."""
    mask = np.array(recording.mask[frame], bool)
    ones = mask.astype(np.float32)
    weight = ones if recording.weight is None else np.where(mask, recording.weight[frame], 0.0)
    return np.where(np.isfinite(recording.velocity[frame]).all(0), weight, 0.0)


class FrameSmoother:
    """Spline fits of a recording's frames; neighbouring frames share what was chosen automatically.

    Args:
        recording: the measurement.
        smoother: options of the fit.
        choose_every: frames that share one choice.
        estimates: of the recording's walls and valves, where they are there already.
    """

    def __init__(
        self,
        recording: geometry.Recording,
        smoother: regularize.Smoother,
        choose_every: int = CHOICE_EVERY,
        *,
        estimates: geometry.Estimates | None = None,
    ) -> None:
        if choose_every < 1:
            raise ValueError(f"choose_every must be at least 1, got {choose_every}")
        refuse_silent(recording)
        refuse_exact(recording)
        self.estimates = geometry.estimated(unwrapped(recording)) if estimates is None else estimates
        recording = self.estimates.recording
        self.type = geometry.measurement_type(recording)
        if smoother.automatic and not self.type.full:
            smoother = smoother.fixed()  # there is no automatic choice from components alone
        if smoother.spacing is None:
            smoother = replace(smoother, spacing=recording.grid.spacing)
        smoother = _for_the_plane(smoother, recording)
        self.motion: geometry.WallMotion | None = None
        self._sampler: geometry.WallSampler | None = None
        if recording.wall is not None:
            self.motion = _motion(recording)
            if smoother.nodes is None:
                self.motion, self._sampler = at_knots(self.motion, max(smoother.knots_at(recording.grid.spacing)))
        self.recording, self.smoother, self.choose_every = recording, smoother, choose_every
        self.nodes = recording.grid.nodes()
        self._choices: dict[int, regularize.Choice | None] = {}
        self._trust: dict[int, float] = {}  # by group, as the choices

    def warn(self) -> None:
        """Warn of all that walls and valves were believed otherwise than the recording has them."""
        for text in self.estimates.warnings:
            warnings.warn(text, stacklevel=3)

    def choice(self, frame: int) -> regularize.Choice | None:
        """What was chosen for the middle frame of the frame's group, or the nearest to it that measured anything.

        None for a smoother with fixed options, and where the whole group has no data.
        """
        if not self.smoother.automatic:
            return None
        group = frame // self.choose_every
        if group not in self._choices:
            middle = _middle(self, group)
            self._choices[group] = None if middle is None else self._chosen(middle)
        return self._choices[group]

    def fit(self, frame: int, *, uncertainty: bool = False) -> regularize.SplineField:
        """The spline of one frame; ``uncertainty`` keeps what its standard deviation needs.

        Raises:
            ValueError: no node has a positive weight.
        """
        return self._fit(frame, uncertainty=uncertainty, choice=self.choice(frame))

    def fit_increments(
        self,
        frame: int,
        points: Tensor,
        samples: Tensor,
        weight: Tensor,
        *,
        choice: regularize.Choice | None = None,
    ) -> list[regularize.SplineField]:
        """Splines of increments (k, n, D) sampled at points (n, D) with confidences (n,); walls are at rest.

        Noise, smoothness and outliers are chosen from the first of them, and the same linear estimate is made of the
        others. ``choice``: noise and smoothness of an earlier increment; None chooses them as well.
        """
        return self._of_increments.fit_many(
            points.double(),
            samples.double(),
            weight.double(),
            self._walls(frame, at_rest=True),
            divergence_points=self._inside(frame),
            choice=choice,
            judged=0,
        )

    def fit_along(
        self,
        frame: int,
        points: Tensor,
        samples: Tensor,
        weight: Tensor,
        beam: Tensor,
        choice: regularize.Choice | None = None,
    ) -> regularize.SplineField:
        """The spline of one increment that is known along unit vectors ``beam`` (n, D) alone.

        Noise and smoothness are those of ``choice``, or the smoother's own.
        """
        known = {} if choice is None else {"curvature": choice.curvature, "no_slip": choice.no_slip}
        return self._of_increments.fixed(**known).fit(
            points.double(),
            samples.double(),
            weight.double(),
            self._walls(frame, at_rest=True),
            divergence_points=self._inside(frame),
            beam=beam,
        )

    @property
    def _of_increments(self) -> regularize.Smoother:
        # a forecast's errors reach as far as those that samples share: the ones would be taken for the others
        return replace(self.smoother, correlated=False)

    def _walls(self, frame: int, *, at_rest: bool = False) -> regularize.WallRows | None:
        """Rows of the walls at a frame; None where the recording has no wall."""
        if self.motion is None:
            return None
        return wall_rows(
            self.recording,
            self.motion,
            frame,
            at_rest=at_rest,
            sampler=self._sampler,
            knots=self._knots,
            free=self.estimates.contradicted,
        )

    @property
    def _knots(self) -> float:
        """Knot distance, m; 0 where the smoother counts coefficients instead."""
        return 0.0 if self.smoother.nodes is not None else max(self.smoother.knots_at(self.recording.grid.spacing))

    def _inside(self, frame: int) -> Tensor:
        """(n, D) nodes in the mask of a frame."""
        return self.nodes[torch.from_numpy(np.array(self.recording.mask[frame], bool).reshape(-1))]

    def _chosen(self, frame: int) -> regularize.Choice | None:
        """What the fit of a frame alone would choose."""
        points, rows, confidence, _ = self._samples(frame)
        where = self._inside(frame)
        return self._trusting(frame).choose(points, rows, confidence, self._walls(frame), divergence_points=where)

    def _samples(self, frame: int) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Points (n, D), velocities (n, D), confidences (n,) and beams of a frame, for the rows of its spline."""
        recording, dimension = self.recording, self.recording.dimension
        mask = torch.from_numpy(np.array(recording.mask[frame], bool).reshape(-1))
        weight = torch.from_numpy(node_weights(recording, frame).astype(np.float64).reshape(-1))
        used = (weight > 0) & mask
        if not bool(used.any()):
            time = float(recording.time[frame])
            raise ValueError(f"frame {frame} (t = {time:g} s) has no node with a positive weight inside the mask")
        field = recording.velocity[frame].reshape(dimension, -1)
        samples = torch.from_numpy(np.nan_to_num(field, copy=True)).double().T
        components = self.type.at(frame, torch.nonzero(used).squeeze(1))
        return components.spline_rows(self.nodes[used], samples[used], weight[used])

    def _fit(
        self,
        frame: int,
        *,
        uncertainty: bool = False,
        choice: regularize.Choice | None = None,
        walls: bool = True,
    ) -> regularize.SplineField:
        recording = self.recording
        points, rows, confidence, beam = self._samples(frame)
        together = self._open_together(frame)
        known_flux = walls and self.motion is not None and (bool(recording.fluxes) or bool(together)) and self.type.full
        smoother = self._trusting(frame) if walls else self.smoother
        fitted = smoother.fit(
            points,
            rows,
            confidence,
            self._walls(frame) if walls else None,
            divergence_points=self._inside(frame),
            beam=beam,
            uncertainty=uncertainty or known_flux,
            choice=choice,
        )
        if self.motion is None or not known_flux:
            return fitted
        fitted = with_fluxes(fitted, recording, self.motion, frame, together, self.estimates)
        if not uncertainty:
            fitted.posterior = fitted.factor = None  # they take as much memory as all else together
        return fitted

    def _open_together(self, frame: int) -> tuple[int, ...]:
        """Regions at a frame whose fluxes are for the data to say (``open_together``)."""
        found, motion = self.estimates.contradicted, self.motion
        return () if motion is None else open_together(self.recording, motion, frame, found)

    def _trusting(self, frame: int) -> regularize.Smoother:
        """The smoother with the strength that the walls of a frame deserve: less where they are uncertain."""
        smoother, group = self.smoother, frame // self.choose_every
        if self.motion is None or not smoother.wall:
            return smoother
        if group not in self._trust:
            self._trust[group] = 1.0
            middle = _middle(self, group)
            if smoother.automatic and middle is not None and self._open_together(middle):
                free, rows = self._fit(middle, uncertainty=True, walls=False), self._walls(middle)
                self._trust[group] = 1.0 if rows is None else wall_trust(free, rows, smoother.wall)
        trust = self._trust[group] * mean_certainty(self.recording, frame, self._knots)
        return smoother if trust == 1.0 else replace(smoother, wall=smoother.wall * trust**0.5)

    @property
    def groups(self) -> int:
        """Number of groups of frames that share a choice."""
        return -(-self.recording.frames // self.choose_every)

    def fitted(
        self, group: int, done: Callable[[], object] = lambda: None
    ) -> tuple[regularize.Choice | None, dict[int, np.ndarray]]:
        """What was chosen for a group, and the fields (D, *shape) of its frames; ``done`` is called after each."""
        first, fields = group * self.choose_every, {}
        for frame in range(first, min(first + self.choose_every, self.recording.frames)):
            if self.measures(frame):
                fields[frame] = self.on_grid(self.fit(frame), frame)
            done()
        return self._choices.get(group), fields

    def adopt(self, group: int, choice: regularize.Choice | None) -> None:
        """Take over what another process chose for a group."""
        if self.smoother.automatic:
            self._choices[group] = choice

    def measures(self, frame: int) -> bool:
        """Whether a frame has anything to fit."""
        return bool((node_weights(self.recording, frame) > 0).any())

    def draws(self, fitted: regularize.SplineField, frame: int, count: int, generator: torch.Generator) -> Tensor:
        """(count, D, *shape) deviations from a fit of ``uncertainty=True``, drawn from its posterior; 0 outside.

        Their RMS over the mask is that of the stated deviation, component by component.

        Raises:
            ValueError: the fit has not kept its uncertainty.
        """
        recording, factor, posterior = self.recording, fitted.factor, fitted.posterior
        if not isinstance(factor, Factor) or posterior is None:
            raise ValueError("draws need a fit that keeps its uncertainty: fit(frame, uncertainty=True)")
        mask = torch.from_numpy(np.array(recording.mask[frame], bool).reshape(-1))
        out = torch.zeros((count, recording.dimension, recording.grid.size), dtype=torch.float64)
        for one in out:
            drawn = torch.zeros((fitted.knots.nodes, recording.dimension), dtype=torch.float64)
            drawn[factor.ordering.nodes] = factor.sample(posterior.precision, generator)
            coefficients = drawn.T.reshape(-1, *fitted.knots.shape)
            one[:, mask] = regularize.SplineField(fitted.knots, coefficients, fitted.covered)(
                self.nodes[mask], outside=0.0
            ).T
        # the factor knows independent errors alone; those that neighbours share make the stated deviation larger
        stated = fitted.std(self.nodes[mask]).double().square().mean(0).sqrt()
        own = out[:, :, mask].square().mean((0, 2)).sqrt().clamp_min(1e-300)
        out *= (stated / own)[:, None]
        return out.reshape(count, recording.dimension, *recording.grid.shape)

    def on_grid(self, fitted: regularize.SplineField, frame: int) -> np.ndarray:
        """The field at the nodes (D, *shape) float32, 0 outside the mask."""
        grid, mask = self.recording.grid, np.array(self.recording.mask[frame], bool).reshape(-1)
        out = np.zeros((grid.dimension, grid.size), np.float32)
        out[:, mask] = fitted(self.nodes[torch.from_numpy(mask)], outside=0.0).T.numpy()
        return out.reshape(grid.dimension, *grid.shape)


def _middle(frames: FrameSmoother, group: int) -> int | None:
    """The middle frame of a group, or the nearest to it that measured anything; None where none did."""
    first = group * frames.choose_every
    members = range(first, min(first + frames.choose_every, frames.recording.frames))
    from_middle = sorted(members, key=lambda k: abs(k - first - frames.choose_every // 2))
    return next((k for k in from_middle if frames.measures(k)), None)


def _for_the_plane(smoother: regularize.Smoother, recording: geometry.Recording) -> regularize.Smoother:
    """The smoother with as much divergence as a plane cut out of a flow has, where it is for us to say."""
    if not recording.cut or smoother.divergence != BY_DATA:
        return smoother
    return replace(smoother, divergence=OF_A_CUT * max(smoother.knots_at(recording.grid.spacing)))


def _motion(recording: geometry.Recording) -> geometry.WallMotion:
    """The motion of the walls; one frame alone is as fast as it says it is, though nobody knows where it goes."""
    motion, wall = geometry.WallMotion.from_recording(recording), recording.wall_for("splines")
    if motion.moves or wall.velocity is None:
        return motion
    return replace(motion, rates_at_keys=wall.velocity[:1].astype(np.float64))


@checked(workers=between(1, MOST_WORKERS))
def smooth(
    measured: geometry.Recording,
    smoother: regularize.Smoother | None = None,
    *,
    progress: bool = False,
    workers: int | None = 1,
) -> geometry.Recording:
    """Fit every frame of a measurement by a penalised B-spline (Grønli 2017, sec. 3.2).

    Noise and smoothness are chosen automatically every few frames; outliers are judged in every frame.

    Args:
        measured: the measurement.
        smoother: options; None takes the default preset.
        progress: show a bar on stderr (only on a terminal).
        workers: processes that share the frames, this one among them; None: as many as it may use cores.

    Returns:
        A recording on the measurement's grid, mask and times.

    Raises:
        RecordingError: nothing was measured, or an error is stated as 0.
        LostWorker: a worker was killed or has crashed.
    """
    frames = FrameSmoother(measured, regularize.Smoother() if smoother is None else smoother)
    frames.warn()
    return smooth_frames(frames, progress, chosen_workers(workers, frames.groups))


def smooth_frames(frames: FrameSmoother, progress: bool = False, workers: int = 1) -> geometry.Recording:
    """``smooth`` with a ``FrameSmoother`` of the caller's, who can then ask it what was chosen.

    A frame in which nothing was measured has no spline: it holds 0 and counts as uncovered. Processes of a run share
    the frames, and so do further ``workers``.
    """
    return spread(partial(_smoothed, frames, progress), partial(_smoothed, frames), workers)


def _smoothed(frames: FrameSmoother, progress: bool = False) -> geometry.Recording:
    """``smooth_frames`` as each of several processes calls it."""
    recording = frames.recording
    fields = np.zeros(recording.velocity.shape, np.float32)
    missing = np.array(
        [0 if frames.measures(f) else np.count_nonzero(recording.mask[f]) for f in range(recording.frames)], np.int64
    )
    with tqdm(total=recording.frames, desc="spline", disable=None if progress else True, unit="frame") as bar:
        groups = [partial(frames.fitted, group, partial(advanced, bar)) for group in range(frames.groups)]
        for group, (choice, fitted) in enumerate(shared(groups)):
            frames.adopt(group, choice)
            for frame, field in fitted.items():
                fields[frame] = field
    return recording.with_velocity(fields, uncovered=missing, description="penalised B-spline, frame by frame")
