"""What a speckle tracker would report of a known flow, by a statistical model instead of an echo simulation.

The model has the traits that a tracker's errors have and white noise lacks: they are correlated over the
tracking kernel, grow with shear, blur the flow, lose slow axial flow to the clutter filter and hop to
false peaks. It is meant for sweeps over noise level and frame rate; :func:`measure_speckle` goes through simulated
echoes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from geometry import Recording
from geometry.grids.fields import fwhm_to_deviation, masked_blur, masked_gradient, smooth_noise

from .aliasing import aliased

WEIGHT_FLOOR = 0.02  # a node that was measured at all keeps some weight: 0 is reserved for "nothing measured"


@dataclass(frozen=True)
class NoiseModel:
    """Options of :func:`measure_noise`.

    Args:
        every: keep each K-th frame of the true recording, starting with the first.
        lateral: m/s, noise deviation across the beam, as RMS over the mask of the whole true recording.
        axial: m/s, the same along the beam.
        outliers: fraction of nodes whose peak hops to anywhere in the search range.
        correlation: m, FWHM of the Gaussian average that colours the noise; its autocorrelation at this lag is
            1/4.
        blur: m, FWHM of the Gaussian average (within the mask) that the tracking kernel does to the flow;
            ``None`` = off.
        shear: 1/s, velocity gradient (Frobenius norm) at which the noise deviation is twice that of a uniform
            flow; ``None`` makes the deviation uniform.
        clutter: m/s, axial speed at which the clutter filter passes 1 - 1/e of the blood; below it the residual
            tissue signal pulls the axial estimate to zero. ``None`` = no clutter filter.
        dropout: fraction of the nodes below the clutter cut-off that report nothing (weight and velocity 0),
            in patches as wide as ``correlation``.
        search: m/s, largest speed per component that the tracker looks for; hops are uniform within it.
        beam_axis: component measured along the beam; the last one is z in volumes, y in planes.
        beam_only: report that component alone, as colour Doppler does: the recording has a ``beam``.
        nyquist: m/s, speed at which each reported component wraps; ``None`` = it does not.
    """

    every: int = 1
    lateral: float = 0.06
    axial: float = 0.025
    outliers: float = 0.01
    correlation: float = 3e-3
    blur: float | None = 3e-3
    shear: float | None = 30.0
    clutter: float | None = 0.05
    dropout: float = 0.05
    search: float = 1.0
    beam_axis: int = -1
    beam_only: bool = False
    nyquist: float | None = None

    def __post_init__(self) -> None:
        if isinstance(self.every, bool) or not isinstance(self.every, int) or self.every < 1:
            raise ValueError(f"every must be a whole number >= 1, got {self.every!r}")
        for name in ("lateral", "axial"):
            _require(name, getattr(self, name), 0.0, math.inf, "a deviation in m/s, >= 0")
        for name in ("outliers", "dropout"):
            _require(name, getattr(self, name), 0.0, 1.0, "a fraction in [0, 1]")
        for name in ("correlation", "search", "blur", "shear", "clutter", "nyquist"):
            value = getattr(self, name)
            if value is None and name in ("blur", "shear", "clutter", "nyquist"):
                continue
            if value is None or not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive and finite, got {value!r}")
        if isinstance(self.beam_axis, bool) or not isinstance(self.beam_axis, int):
            raise ValueError(f"beam_axis must be a component index, got {self.beam_axis!r}")


def _require(name: str, value: float, low: float, high: float, rule: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ValueError(f"{name} must be {rule}, got {value!r}")


def measure_noise(true: Recording, options: NoiseModel, seed: int) -> Recording:
    """A measurement of a recording by the noise model: every K-th frame, walls, valves and mask kept.

    The noise of a frame depends on ``seed`` and the frame's index in ``true`` alone, so a sweep over
    ``every`` compares the same noise.

    Args:
        true: what is measured.
        options: of the noise model.
        seed: of the noise, >= 0.

    Returns:
        A recording with ``weight`` in [0, 1], which plays the speckle correlation: it follows the
        blood-to-clutter power (so it rises with axial speed), falls a little with shear and scatters at
        random, and never sees the noise that was drawn. Its rank correlation with the error is therefore weak,
        about +0.2 on a ventricle (the sign is that of real trackers after a clutter filter: slow flow is dim
        and yet not the worst tracked).

    Raises:
        ValueError: where ``every`` leaves no second frame although ``true`` has several, or ``beam_axis`` is
            not a component.
    """
    dimension = true.velocity.shape[1]
    if not -dimension <= options.beam_axis < dimension:
        raise ValueError(f"beam_axis {options.beam_axis} is not a component of a {dimension}-D recording")
    frames = range(0, len(true.time), options.every)
    if len(frames) < 2 <= len(true.time):
        raise ValueError(f"every = {options.every} leaves one of {len(true.time)} frames; choose it smaller")
    spacing = tuple(float(step) for step in true.grid.spacing)
    scale = 1.0 / _mean_growth(true, spacing, options)
    velocity = np.zeros((len(frames), *true.velocity.shape[1:]), np.float32)
    weight = np.zeros((len(frames), *true.velocity.shape[2:]), np.float32)
    for row, frame in enumerate(frames):
        generator = torch.Generator().manual_seed(frame_seed(seed, frame))
        measured, confidence = measure_frame(
            torch.from_numpy(np.ascontiguousarray(true.velocity[frame], np.float32)),
            torch.from_numpy(np.ascontiguousarray(true.mask[frame], bool)),
            spacing,
            options,
            generator,
            scale=scale,
        )
        velocity[row], weight[row] = measured.numpy(), confidence.numpy()
    return _as_measurement(true, list(frames), velocity, weight, options, seed)


def measure_frame(
    velocity: Tensor,
    mask: Tensor,
    spacing: tuple[float, ...],
    options: NoiseModel,
    generator: torch.Generator,
    *,
    scale: float = 1.0,
) -> tuple[Tensor, Tensor]:
    """One frame: what is measured (D, *shape), m/s, and its weight (*shape).

    The order of the draws is fixed, so that one option leaves the noise of others alone.

    Args:
        velocity: (D, *shape), m/s.
        mask: (*shape), bool.
        spacing: (D,), m, in the order x, y, z (the reverse of the array's).
        options: of the noise model.
        generator: draws the noise.
        scale: factor of the deviations, to make them RMS values over a recording.
    """
    dimension = velocity.shape[0]
    axial = options.beam_axis % dimension
    growth = noise_growth(velocity, mask, spacing, options)
    seen = velocity if options.blur is None else masked_blur(velocity, mask, fwhm_to_deviation(options.blur), spacing)
    noise = smooth_noise(
        dimension + 2,
        mask.shape,
        fwhm_to_deviation(options.correlation),
        spacing,
        generator,
        dtype=velocity.dtype,
    )
    scatter = torch.randn(mask.shape, generator=generator, dtype=velocity.dtype)
    hop = torch.rand(mask.shape, generator=generator) < options.outliers
    false_peak = options.search * (2 * torch.rand(velocity.shape, generator=generator, dtype=velocity.dtype) - 1)

    passed = _passed_power(seen[axial], options)
    deviation = torch.full((dimension,), options.lateral, dtype=velocity.dtype)
    deviation[axial] = options.axial
    seen = seen.clone()
    seen[axial] *= passed
    seen += noise[:dimension] * (deviation.view(-1, *[1] * mask.dim()) * scale * growth)
    measured = torch.where(hop, false_peak, seen)

    weight = _confidence(passed, growth, noise[dimension], scatter)
    lost = torch.special.ndtr(noise[dimension + 1]) < options.dropout * (1 - passed)
    live = mask & ~lost
    return measured * live, weight * live


def noise_growth(velocity: Tensor, mask: Tensor, spacing: tuple[float, ...], options: NoiseModel) -> Tensor:
    """Factor (*shape) by which velocity gradients raise the noise: 1 + |grad v| / shear; see :func:`measure_frame`."""
    if options.shear is None:
        return torch.ones(mask.shape, dtype=velocity.dtype)
    gradient = masked_gradient(velocity, mask, spacing)
    return 1 + gradient.square().sum((0, 1)).sqrt() / options.shear


def frame_seed(seed: int, frame: int) -> int:
    """A generator seed for one frame, statistically independent of those of other frames and other seeds."""
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ValueError(f"seed must be a whole number >= 0, got {seed!r}")
    return int(np.random.SeedSequence([seed, frame]).generate_state(1, np.uint64)[0] >> np.uint64(1))


def _mean_growth(true: Recording, spacing: tuple[float, ...], options: NoiseModel) -> float:
    """RMS of the growth factor over the mask and all frames: it makes ``lateral`` an RMS value."""
    total, nodes = 0.0, 0
    for frame in range(len(true.time)):
        mask = torch.from_numpy(np.ascontiguousarray(true.mask[frame], bool))
        velocity = torch.from_numpy(np.ascontiguousarray(true.velocity[frame], np.float32))
        total += float(noise_growth(velocity, mask, spacing, options)[mask].double().square().sum())
        nodes += int(mask.sum())
    return math.sqrt(total / nodes) if nodes else 1.0


def _passed_power(axial_velocity: Tensor, options: NoiseModel) -> Tensor:
    """Fraction of the blood's power that a high-pass with its knee at ``clutter`` lets through."""
    if options.clutter is None:
        return torch.ones_like(axial_velocity)
    return 1 - torch.exp(-(axial_velocity / options.clutter).square())


def _confidence(passed: Tensor, growth: Tensor, patchy: Tensor, scatter: Tensor) -> Tensor:
    """Stand-in for the speckle correlation: power passed, decorrelation by shear, and mostly chance."""
    mean = 0.46 + 0.36 * passed - 0.01 * (growth - 1)
    return (mean + 0.12 * patchy + 0.12 * scatter).clamp(WEIGHT_FLOOR, 1.0)


def _as_measurement(
    true: Recording, frames: list[int], velocity: np.ndarray, weight: np.ndarray, options: NoiseModel, seed: int
) -> Recording:
    description = (
        f"measurement by a noise model, lateral {options.lateral:g}, axial {options.axial:g} m/s, "
        f"outliers {options.outliers:g}, every {options.every}, seed {seed}"
    )
    measured = replace(true.select(frames).with_velocity(velocity, description=description), weight=weight)
    if options.beam_only:
        beam = np.zeros(true.velocity.shape[1:], np.float32)
        beam[options.beam_axis] = 1
        measured = replace(measured, velocity=velocity * beam, beam=beam)
    return measured if options.nyquist is None else aliased(measured, options.nyquist)
