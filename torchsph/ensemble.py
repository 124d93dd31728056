"""The ensemble filter over a recording: forecast all members in one batch, analyse each frame, go on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import geometry
import regularize

from .assimilation import LETKF, RTPS, Analysis, Filter, HybridGain, Localisation, Observations, replace_failed
from .forecast import GridForecast, Transfer
from .observation_error import ObservationError, estimate_error
from .perturbations import flow_perturbations
from .simulator import Simulator
from .smooth import FrameSmoother, node_weights, smooth_frames


@dataclass(frozen=True)
class EnsembleOptions:
    """Settings of the cycle; lengths and speeds are relative to the scene, so that hearts of any size fit.

    Attributes:
        initial_spread: RMS per component of the first perturbations, share of the first field's RMS per component.
        model_error: the same for the perturbations added to every forecast, share of the RMS of the forecast's mean
            or of all splines, whichever is larger.
        length: correlation length of both, in mean grid spacings.
        localisation: radius at which observations lose all influence, share of the walls' longest extent.
        relaxation: RTPS factor. gross_error: rejection limit in expected standard deviations, or None.
        spline_share: weight of the spline-space analysis in the hybrid gain; 0 leaves the LETKF alone.
        choose_every: frames after which the smoothness of the innovations is chosen anew.
        memory: frames over which the observation error is averaged that the innovations show.
        transfer: how grid forecasts are put together.
    """

    initial_spread: float = 0.35
    model_error: float = 0.2
    length: float = 2.0
    localisation: float = 0.33
    relaxation: float = 0.5
    gross_error: float | None = None
    spline_share: float = 0.5
    choose_every: int = 3
    memory: float = 5.0
    transfer: Transfer = Transfer()

    def __post_init__(self) -> None:
        for name in ("initial_spread", "length", "localisation", "memory"):
            if not getattr(self, name) > 0:
                raise ValueError(f"EnsembleOptions.{name} must be positive, got {getattr(self, name)}")
        for name in ("model_error", "relaxation", "spline_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"EnsembleOptions.{name} must lie in [0, 1], got {getattr(self, name)}")


@dataclass(frozen=True)
class EnsembleRun:
    """The analyses of a recording, with the standard deviation the filter claims, and the accounts."""

    recording: geometry.Recording
    info: dict[str, object]


def default_filter(measured: geometry.Recording, options: EnsembleOptions) -> LETKF:
    """Local ensemble transform Kalman filter with RTPS, its radius from the size of the walls."""
    vertices = measured.wall.at(0).vertices
    radius = options.localisation * float(np.ptp(vertices, axis=0).max())
    return LETKF(
        localisation=Localisation(radius), inflation=RTPS(options.relaxation), gross_error=options.gross_error
    )


def assimilate(
    measured: geometry.Recording, model: Simulator, *, members: int = 16, filter: Filter | None = None,
    options: EnsembleOptions | None = None, splines: FrameSmoother | None = None,
    smoothed: geometry.Recording | None = None, seed: int = 0, progress: bool = False,
) -> EnsembleRun:
    """Assimilate a measurement into an ensemble of SPH simulations.

    The first frame's spline, perturbed, makes the ensemble. Every cycle imposes the members' grids on particles,
    advances all of them in one batch to the next frame, fetches the grids, perturbs them with model error and lets
    the filter update them with the frame. With ``spline_share`` the mean moves towards a second analysis: the forecast
    mean plus the penalised spline of the innovation (hybrid gain).

    Args:
        measured: the recording. model: simulator of its scene. members: at least 2.
        filter: any ``torchsph.assimilation`` filter; None takes ``default_filter``.
        splines: of the first field and the spline-space analysis. smoothed: their result, where it is there already.
        seed: of everything random.

    Raises:
        ValueError: fewer than two members. NumericalFailure: all members failed.
    """
    if members < 2:
        raise ValueError(f"an ensemble needs at least 2 members, got {members}")
    options = EnsembleOptions() if options is None else options
    splines = FrameSmoother(measured, regularize.Smoother()) if splines is None else splines
    smoothed = smooth_frames(splines, progress) if smoothed is None else smoothed
    cycle = _Cycle(model, members, filter or default_filter(measured, options), options, splines,
                   estimate_error(measured, splines, smoothed), torch.Generator().manual_seed(seed))
    cycle.begin(smoothed)
    frames = tqdm(range(1, measured.frames), desc="ensemble", unit="frame", disable=None if progress else True)
    for frame in frames:
        cycle.step(frame, seed)
    return cycle.result(members)


class _Cycle:
    """State of the filter on its way through the frames."""

    def __init__(
        self, model: Simulator, members: int, filter_: Filter, options: EnsembleOptions, splines: FrameSmoother,
        error: ObservationError, generator: torch.Generator,
    ) -> None:
        measured = splines.recording
        self.measured, self.model, self.members, self.filter = measured, model, members, filter_
        self.options, self.error, self.generator = options, error, generator
        self.splines, self.increment_choice = splines, None
        self.grid = measured.grid
        self.nodes = self.grid.nodes()
        self.length = options.length * float(np.mean(self.grid.spacing))
        self.scale = np.ones(measured.dimension)
        self.fields: list[np.ndarray] = []
        self.sigmas: list[np.ndarray] = []
        self.missing: list[int] = []
        self.frames_info: list[dict[str, object]] = []
        self.replaced = 0

    def mask(self, frame: int) -> np.ndarray:
        return np.array(self.measured.mask[frame], bool)

    def begin(self, smoothed: geometry.Recording) -> None:
        mask = self.mask(0)
        mean = torch.from_numpy(np.where(mask, smoothed.velocity[0], 0.0))
        inside = np.moveaxis(smoothed.velocity, 1, -1)[np.asarray(smoothed.mask, bool)]
        self.usual = float(np.sqrt(np.mean(np.square(inside, dtype=np.float64))))
        self.ensemble = mean + self._perturbations(0, mean, self.options.initial_spread)
        self._keep(mean.numpy(), self.ensemble.std(0).numpy(), 0)

    def _perturbations(self, frame: int, mean: Tensor, share: float, least: float = 0.0) -> Tensor:
        mask = self.mask(frame)
        rms = max(float(mean[:, torch.from_numpy(mask)].square().mean().sqrt()), least)
        return flow_perturbations(
            self.members, mask, self.grid.spacing, share * rms, self.length, self.generator
        ).to(mean.dtype)

    def step(self, frame: int, seed: int) -> None:
        early, late = torch.from_numpy(self.mask(frame - 1)), torch.from_numpy(self.mask(frame))
        going = GridForecast(
            self.model, self.grid, self.ensemble.to(self.model.device), early.to(self.model.device),
            float(self.measured.time[frame - 1]), self.options.transfer, seed=seed,
        )
        value, covered = going.at(float(self.measured.time[frame]), late.to(self.model.device))
        forecast = value.cpu().to(torch.float32)
        failed = going.run.record.failed.cpu()
        if bool(failed.any()):
            forecast = replace_failed(forecast.flatten(1), failed, generator=self.generator).ensemble.reshape(
                forecast.shape
            )
            self.replaced += int(failed.sum())
        if self.options.model_error > 0:
            forecast = forecast + self._perturbations(frame, forecast.mean(0), self.options.model_error, self.usual)
        self._analyse(forecast, frame, int((late & ~covered[0].cpu()).sum()))

    def _analyse(self, forecast: Tensor, frame: int, missing: int) -> None:
        mask = self.mask(frame)
        inside = torch.from_numpy(np.flatnonzero(mask))
        state = forecast.flatten(2)[:, :, inside].flatten(1)
        observations = self._observations(frame, inside)
        acting = self.filter
        if self.options.spline_share > 0:
            acting = HybridGain(filter=self.filter, second=self._spline_analysis(frame, inside),
                                weight=self.options.spline_share)
        analysis = acting.analyse(
            state, state, observations, state_positions=self.nodes[inside], generator=self.generator
        )
        self._learn_scale(analysis, state)
        shape = (self.members, self.measured.dimension, self.grid.size)
        full = torch.zeros(shape, dtype=state.dtype)
        full[:, :, inside] = analysis.ensemble.reshape(self.members, shape[1], -1)
        self.ensemble = full.reshape(forecast.shape)
        sigma = torch.zeros(shape[1:], dtype=state.dtype)
        sigma[:, inside] = analysis.variance.clamp_min(0).sqrt().reshape(shape[1], -1)
        field = torch.zeros(shape[1:], dtype=state.dtype)
        field[:, inside] = analysis.mean.reshape(shape[1], -1)
        self._keep(field.reshape(shape[1], *self.grid.shape).numpy(),
                   sigma.reshape(shape[1], *self.grid.shape).numpy(), missing)
        normalised = analysis.normalised_innovation()
        self.frames_info.append({
            "time": float(self.measured.time[frame]), "observations": analysis.counts(),
            "normalised_innovation": float(normalised[analysis.reason == 0].square().mean().sqrt()),
            "spread_before": float(analysis.spread_before), "spread_after": float(analysis.spread_after),
            "warnings": list(analysis.warnings),
        })

    def _observations(self, frame: int, inside: Tensor) -> Observations:
        value = torch.from_numpy(self.measured.velocity[frame].astype(np.float64)).flatten(1)[:, inside]
        shape = (-1,) + (1,) * self.measured.dimension
        variance = self.error.variance(self.measured, frame) * self.scale.reshape(shape)
        spread = torch.from_numpy(variance).flatten(1)[:, inside]
        value = torch.where(torch.isfinite(spread), value, torch.nan)
        return Observations(
            value.flatten(), spread.flatten(), position=self.nodes[inside],
            redundancy=float(self.error.redundancy[frame])
        )

    def _learn_scale(self, analysis: Analysis, state: Tensor) -> None:
        """Adapt the observation error to what the innovations show beyond the ensemble's own variance, slowly."""
        parts = self.measured.dimension
        used = (analysis.reason == 0).reshape(parts, -1)
        squared = analysis.innovation.square().reshape(parts, -1)
        own = state.double().var(0).reshape(parts, -1)
        stated = analysis.innovation_variance.reshape(parts, -1) - own
        for c in range(parts):
            if bool(used[c].any()):
                shown = float((squared[c][used[c]].mean() - own[c][used[c]].mean()) / stated[c][used[c]].mean())
                self.scale[c] *= min(max(shown, 0.25), 4.0) ** (1.0 / self.options.memory)

    def _spline_analysis(self, frame: int, inside: Tensor):
        """The forecast mean plus the penalised spline of the innovation: an analysis in spline space."""

        def analyse(mean: Tensor, observations: Observations) -> Tensor:
            parts = self.measured.dimension
            kept = (observations.codes() == 0).reshape(parts, -1).all(0).numpy()
            innovation = np.zeros((parts, self.grid.size), np.float32)
            innovation[:, inside] = np.nan_to_num(
                (observations.value - mean.double()).reshape(parts, -1).numpy()
            )
            weight = np.zeros(self.grid.size, np.float32)
            weight[inside.numpy()] = node_weights(self.measured, frame).reshape(-1)[inside.numpy()] * kept
            if not (weight > 0).any():
                return mean
            shape = self.grid.shape
            # innovations have a smoothness of their own, chosen from them as the cycle goes
            anew = (frame - 1) % self.options.choose_every == 0
            fitted = self.splines.fit_increment(
                frame, innovation.reshape(parts, *shape), weight.reshape(shape), None if anew else self.increment_choice
            )
            self.increment_choice = fitted.choice
            change = self.splines.on_grid(fitted, frame)
            return mean + torch.from_numpy(change).reshape(parts, -1)[:, inside].flatten().to(mean.dtype)

        return analyse

    def _keep(self, field: np.ndarray, sigma: np.ndarray, missing: int) -> None:
        self.fields.append(field)
        self.sigmas.append(sigma)
        self.missing.append(missing)

    def result(self, members: int) -> EnsembleRun:
        recording = self.measured.with_velocity(
            np.stack(self.fields).astype(np.float32), sigma=np.stack(self.sigmas).astype(np.float32),
            uncovered=np.array(self.missing, np.int64), description=f"ensemble of {members} SPH simulations",
        )
        info: dict[str, object] = {
            "members": members, "replaced_members": self.replaced, "frames": self.frames_info,
            "observation_error_scale": self.scale.tolist(), "options": repr(self.options),
        }
        return EnsembleRun(recording, info)

