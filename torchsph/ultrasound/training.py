"""Simulations on which a tracker's confidence is calibrated: random swirls inside tissue."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from geometry import Grid

from .calibration import Calibration, fit_calibration
from .echoes import EchoModel, simulate_packet
from .estimates import Estimates
from .plugin import Tracker

IN_PLANE = 4
FINEST, COARSEST = 0.25, 3.0  # 2 mm, which is twice a kernel of table 3.1, to 24 mm for the default plan


@dataclass(frozen=True, eq=False)
class SwirlFlow:
    """Random divergence-free flow in a ball (a disc in 2-D) of tissue that moves as a whole, steady in time.

    A sum of transverse plane waves, each a random ``wave`` vector (m, D), rad/m, with an ``amplitude`` (m, D)
    across it, m/s, and a ``phase`` (m,), on top of a ``mean`` (D,); blood within ``radius`` of ``centre``.
    ``tissue`` (D,): velocity of the tissue, m/s.
    """

    wave: Tensor
    amplitude: Tensor
    phase: Tensor
    mean: Tensor
    centre: Tensor
    radius: float
    tissue: Tensor

    def velocity(self, points: Tensor, time: float) -> Tensor:
        offset = points - self.centre.to(points)
        field = torch.sin(offset @ self.wave.to(points).T + self.phase.to(points)) @ self.amplitude.to(points)
        # no slip: the last half millimetre of blood goes over to the velocity of the tissue
        fade = ((self.radius - offset.norm(dim=1)) / 0.5e-3).clamp(0, 1)[:, None]
        return (field + self.mean.to(points)) * fade + self.tissue.to(points) * (1 - fade)

    def blood(self, points: Tensor, time: float) -> Tensor:
        return (points - self.centre.to(points)).norm(dim=1) < self.radius


def random_swirl(
    centre: tuple[float, ...], radius: float, speed: float, generator: torch.Generator,
    *, waves: int = 6, tissue_speed: float = 0.0,
) -> SwirlFlow:  # fmt: skip
    """A swirl of RMS ``speed``, m/s, with wavelengths of ``FINEST`` to ``COARSEST`` diameters of the ball.

    They are spread evenly on a logarithmic scale: vortices as large as a ventricle, shear layers that a kernel
    hardly resolves.

    Each component of the tissue's velocity is drawn with a deviation of ``tissue_speed``, m/s.
    """
    dimension = len(centre)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64, device=generator.device)

    direction = torch.nn.functional.normalize(normal(waves, dimension), dim=1)
    share = torch.rand(waves, generator=generator, dtype=torch.float64, device=generator.device)
    length = 2 * radius * FINEST * (COARSEST / FINEST) ** share
    amplitude = normal(waves, dimension)
    amplitude = amplitude - (amplitude * direction).sum(1, keepdim=True) * direction
    mean = normal(dimension)
    scale = speed / math.sqrt(0.5 * float(amplitude.square().sum()) + float(mean.square().sum()))
    phase = 2 * math.pi * torch.rand(waves, generator=generator, dtype=torch.float64, device=generator.device)
    wave = direction * (2 * math.pi / length)[:, None]
    tissue = normal(dimension) * tissue_speed
    return SwirlFlow(wave, amplitude * scale, phase, mean * scale, mean.new_tensor(centre), radius, tissue)


@dataclass(frozen=True)
class TrainingPlan:
    """simulations: packets in space; a plane, which holds fewer points, takes ``IN_PLANE`` times as many.

    radius: of the blood, m. margin: tissue around it in view, m. step: between points, m.
    slowest, fastest: RMS speeds, m/s, spread evenly over the simulations on a logarithmic scale.
    tissue_speed: deviation of each component of the tissue's velocity, m/s.
    """

    simulations: int = 12
    radius: float = 4e-3
    margin: float = 1.5e-3
    step: float = 1e-3
    slowest: float = 0.05
    fastest: float = 0.5
    tissue_speed: float = 0.02

    def __post_init__(self) -> None:
        if (
            isinstance(self.simulations, bool)
            or not isinstance(self.simulations, int)
            or self.simulations < 2
        ):
            raise ValueError(f"simulations must be a whole number >= 2, got {self.simulations!r}")
        for name in ("radius", "step", "slowest", "fastest"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)!r}")


def training_points(plan: TrainingPlan, centre: tuple[float, ...]) -> Tensor:
    """Points (n, D) to track: a lattice inside the ball."""
    half = int(plan.radius / plan.step)
    axis = torch.arange(-half, half + 1, dtype=torch.float64) * plan.step
    lattice = torch.cartesian_prod(*[axis] * len(centre))
    return lattice[lattice.norm(dim=1) < plan.radius] + lattice.new_tensor(centre)


def calibrate(
    model: EchoModel, tracker: Tracker, spacing: tuple[float, ...], generator: torch.Generator,
    plan: TrainingPlan = TrainingPlan(), *, centre: tuple[float, ...] | None = None,
) -> Calibration:  # fmt: skip
    """Fit deviations and weights of ``tracker`` on random swirls; image ``spacing`` x, y, z, m.

    centre: of the swirls, m, where beams from an apex make the place matter; ``None`` = the origin.
    """
    centre = centre or (0.0,) * len(spacing)
    reach = plan.radius + plan.margin
    # symmetric about the middle, so that the points to track fall on image nodes whenever step is a multiple
    sides = [math.ceil(reach / s) for s in spacing]
    grid = Grid(
        tuple(c - n * s for c, n, s in zip(centre, sides, spacing, strict=True)),
        spacing,
        tuple(2 * n + 1 for n in reversed(sides)),
    )
    points = training_points(plan, centre).to(generator.device)
    parts, errors = [], []
    simulations = plan.simulations * (IN_PLANE if grid.dimension == 2 else 1)
    for number in range(simulations):
        share = number / (simulations - 1)
        speed = plan.slowest ** (1 - share) * plan.fastest**share
        flow = random_swirl(centre, plan.radius, speed, generator, tissue_speed=plan.tissue_speed)
        estimates = tracker.track(simulate_packet(flow, grid, model, 0.0, generator), points)
        parts.append(estimates)
        errors.append(estimates.velocity - flow.velocity(points, 0.0).to(estimates.velocity))
    beam = model.beams.directions(torch.cat([points] * simulations)).to(errors[0])
    return fit_calibration(Estimates.joined(parts), torch.cat(errors), beam)
