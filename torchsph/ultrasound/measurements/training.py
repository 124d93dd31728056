"""Simulations on which a tracker's confidence is calibrated: random swirls beside tissue."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from geometry import Grid

from ..estimation.estimates import Estimates
from ..estimation.plugin import Tracker
from ..scanner.echoes import EchoModel, simulate_packet
from .calibration import Calibration, fit_calibration

IN_PLANE = 4
FINEST, COARSEST = 0.25, 3.0  # 2 mm, twice a kernel of Grønli 2017, table 3.1, to 24 mm in the default plan
SMOOTHEST = 4.0  # times FINEST
NEAREST, FARTHEST = 0.25, 1.5  # of the wall from the middle of the view, in half sides of the latter
FLATTEST = 5.0  # radius of the wall's curvature, likewise


@dataclass(frozen=True, eq=False)
class SwirlFlow:
    """Random divergence-free flow in a ball (a disc in 2-D) of tissue that moves as a whole, steady in time.

    A sum of m transverse plane waves on top of a mean.

    Args:
        wave: (m, D), rad/m, wave vectors.
        amplitude: (m, D), m/s, each across its wave vector.
        phase: (m,), rad.
        mean: (D,), m/s.
        centre: (D,), m, of the ball.
        radius: m, within which there is blood.
        tissue: (D,), m/s, velocity of the tissue.
    """

    wave: Tensor
    amplitude: Tensor
    phase: Tensor
    mean: Tensor
    centre: Tensor
    radius: float
    tissue: Tensor

    def velocity(self, points: Tensor, time: float) -> Tensor:
        """See :class:`Flow`."""
        offset = points - self.centre.to(points)
        field = torch.sin(offset @ self.wave.to(points).T + self.phase.to(points)) @ self.amplitude.to(points)
        # no slip: the last half millimetre of blood goes over to the velocity of the tissue
        fade = ((self.radius - offset.norm(dim=1)) / 0.5e-3).clamp(0, 1)[:, None]
        return (field + self.mean.to(points)) * fade + self.tissue.to(points) * (1 - fade)

    def blood(self, points: Tensor, time: float) -> Tensor:
        """See :class:`Flow`."""
        return (points - self.centre.to(points)).norm(dim=1) < self.radius


def random_swirl(
    centre: tuple[float, ...],
    radius: float,
    speed: float,
    generator: torch.Generator,
    *,
    waves: int = 6,
    tissue_speed: float = 0.0,
    finest: float = FINEST,
) -> SwirlFlow:
    """A swirl with wavelengths of ``finest`` to ``COARSEST`` diameters of the ball.

    They are spread evenly on a logarithmic scale: vortices as large as a ventricle, shear layers that a kernel
    hardly resolves.

    Args:
        centre: (D,), m, of the ball.
        radius: m, of the ball.
        speed: m/s, RMS of the flow.
        generator: draws the flow, on the device of its tensors.
        waves: how many plane waves.
        tissue_speed: m/s, standard deviation of each component of the tissue's velocity.
        finest: shortest wavelength, in diameters of the ball.
    """
    dimension = len(centre)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64, device=generator.device)

    direction = torch.nn.functional.normalize(normal(waves, dimension), dim=1)
    share = torch.rand(waves, generator=generator, dtype=torch.float64, device=generator.device)
    length = 2 * radius * finest * (COARSEST / finest) ** share
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
    """The simulations on which a tracker is calibrated.

    Args:
        simulations: packets in space; a plane, which holds fewer points, takes ``IN_PLANE`` times as many.
        half: m, half the side of the cube (square) that is tracked.
        margin: m, of image around it.
        step: m, between points.
        slowest: m/s, least RMS speed; they are spread evenly over the simulations on a logarithmic scale.
        fastest: m/s, greatest RMS speed.
        tissue_speed: m/s, standard deviation of each component of the tissue's velocity.
    """

    simulations: int = 48
    half: float = 4e-3
    margin: float = 1.5e-3
    step: float = 1e-3
    slowest: float = 0.05
    fastest: float = 0.5
    tissue_speed: float = 0.02

    def __post_init__(self) -> None:
        if isinstance(self.simulations, bool) or not isinstance(self.simulations, int) or self.simulations < 2:
            raise ValueError(f"simulations must be a whole number >= 2, got {self.simulations!r}")
        for name in ("half", "step", "slowest", "fastest"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)!r}")


def random_scene(
    centre: tuple[float, ...], half: float, speed: float, generator: torch.Generator, *, tissue_speed: float = 0.0
) -> SwirlFlow:
    """Blood beside a wall of tissue, in view of a cube (square).

    How far the wall is from the centre, where it lies and how it is bent are random, and so is how smooth the
    flow is: one half of the flows has wavelengths down to ``FINEST`` diameters of the view, the
    shortest of the other half are anywhere from there to ``SMOOTHEST`` times as long. What a flow does within a
    kernel hardly shows in its echoes, yet shifts a kernel's mean.

    Args:
        centre: (D,), m, of the view.
        half: m, half the side of the view.
        speed: m/s, RMS of the flow.
        generator: draws wall and flow.
        tissue_speed: m/s, standard deviation of each component of the tissue's velocity.
    """
    dimension = len(centre)
    device = generator.device
    near, bent, smooth = torch.rand(3, generator=generator, dtype=torch.float64, device=device).tolist()
    normal = torch.randn(dimension, generator=generator, dtype=torch.float64, device=device)
    away = torch.nn.functional.normalize(normal, dim=0)
    finest = FINEST * SMOOTHEST ** max(0.0, 2 * smooth - 1)
    swirl = random_swirl(centre, half, speed, generator, tissue_speed=tissue_speed, finest=finest)
    radius = half * (1 + (FLATTEST - 1) * bent)
    inwards = radius - half * (NEAREST + (FARTHEST - NEAREST) * near)
    return replace(swirl, centre=swirl.centre - inwards * away, radius=radius)


def training_points(plan: TrainingPlan, centre: tuple[float, ...]) -> Tensor:
    """A lattice of points (n, D), m, around ``centre`` (D,), m, to be tracked where they lie in blood."""
    count = int(plan.half / plan.step)
    axis = torch.arange(-count, count + 1, dtype=torch.float64) * plan.step
    return torch.cartesian_prod(*[axis] * len(centre)) + axis.new_tensor(centre)


def calibrate(
    model: EchoModel,
    tracker: Tracker,
    spacing: tuple[float, ...],
    generator: torch.Generator,
    plan: TrainingPlan = TrainingPlan(),
    *,
    centre: tuple[float, ...] | None = None,
) -> Calibration:
    """Fit deviations and weights of a tracker on random scenes.

    Args:
        model: the scanner.
        tracker: what is calibrated.
        spacing: (D,), m, of the image, in the order x, y, z.
        generator: draws scenes, scatterers and noise.
        plan: how many scenes, and what they are like.
        centre: (D,), m, of the scenes, where beams from an apex make the place matter; ``None`` = the origin.
    """
    centre = centre or (0.0,) * len(spacing)
    reach = plan.half + plan.margin
    # symmetric about the middle, so that the points to track fall on image nodes whenever step is a multiple
    sides = [math.ceil(reach / s) for s in spacing]
    grid = Grid(
        tuple(c - n * s for c, n, s in zip(centre, sides, spacing, strict=True)),
        spacing,
        tuple(2 * n + 1 for n in reversed(sides)),
    )
    lattice = training_points(plan, centre).to(generator.device)
    parts, errors, tracked = [], [], []
    simulations = plan.simulations * (IN_PLANE if grid.dimension == 2 else 1)
    for number in range(simulations):
        share = number / (simulations - 1)
        speed = plan.slowest ** (1 - share) * plan.fastest**share
        flow = random_scene(centre, plan.half, speed, generator, tissue_speed=plan.tissue_speed)
        points = lattice[flow.blood(lattice, 0.0)]
        estimates = tracker.track(simulate_packet(flow, grid, model, 0.0, generator), points)
        parts.append(estimates)
        errors.append(estimates.velocity - flow.velocity(points, 0.0).to(estimates.velocity))
        tracked.append(points)
    beam = model.beams.directions(torch.cat(tracked)).to(errors[0])
    return fit_calibration(Estimates.joined(parts), torch.cat(errors), beam)
