"""Flows with known solutions, ready to run from their start: vortices, channels, a cavity; for tests and benchmarks."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

import geometry
from torchsph.pairs import choose_backend
from torchsph.pairs.moving_least_squares import fetch_at
from torchsph.simulator.scene import Fluid, Scene
from torchsph.simulator.schemes.scheme import Scheme
from torchsph.simulator.schemes.weakly_compressible import WeaklyCompressible
from torchsph.simulator.seeding import Seeding
from torchsph.simulator.simulation import FETCH_RADIUS, Simulation
from torchsph.simulator.simulator import Simulator

from . import exact_flows

_LATTICE = Seeding(jitter=0.0)
_CHANNEL_VISCOSITY = 0.1


def taylor_green(
    resolution: int,
    reynolds: float = 100.0,
    *,
    dimension: int = 2,
    scheme: Scheme | None = None,
    backend: str = "auto",
    seeding: Seeding = _LATTICE,
) -> Simulation:
    """A Taylor-Green vortex on resolution^dimension particles at its start: velocity and pressure as they should be.

    In the plane the period is 1 m, in space 2 pi m; U = 1 m/s and nu = 1 / reynolds m^2/s.

    Args:
        resolution: particles along each axis.
        reynolds: Reynolds number.
        dimension: 2 or 3.
        scheme: None: the weakly compressible one with the options for periodic flows.
        backend: name of the pair backend.
        seeding: how particles are placed.
    """
    plane = dimension == 2
    side = 1.0 if plane else 2 * math.pi
    if scheme is None:
        options = exact_flows.PERIODIC_OPTIONS if plane else exact_flows.PERIODIC_OPTIONS_3D
        scheme = WeaklyCompressible(**options)
    scene = Scene(
        spacing=side / resolution, fluid=Fluid(1.0, 1 / reynolds), period=(side,) * dimension, dimension=dimension
    )
    run = Simulator(scene, scheme, backend=backend, seeding=seeding).start(0.0)
    points = run.particles.position * scene.spacing
    if plane:
        velocity = exact_flows.taylor_green_2d(points, 0.0, 1 / reynolds)
        pressure = exact_flows.taylor_green_2d_pressure(points, 0.0, 1 / reynolds)
    else:
        velocity, pressure = exact_flows.taylor_green_3d(points), exact_flows.taylor_green_3d_pressure(points)
    deviation = torch.zeros_like(pressure)
    if isinstance(scheme, WeaklyCompressible):  # an incompressible fluid finds its pressure by itself
        deviation = pressure / scheme.sound_speed**2
    run.particles = run.particles.changed(velocity=velocity, deviation=deviation)
    return run


def taylor_green_error(run: Simulation) -> float:
    """Relative L2 error of the particles' velocities in a ``taylor_green`` run in the plane, at its present time."""
    points, velocity = _points(run), run.particles.velocity.double()
    exact = exact_flows.taylor_green_2d(points, run.time, run.simulator.scene.fluid.kinematic_viscosity)
    return float((velocity - exact).norm() / exact.norm())


def kinetic_energy(run: Simulation) -> float:
    """Kinetic energy per mass, m^2/s^2 (reference speed 1 m/s)."""
    return float(run.particles.velocity.double().square().sum(1).mean()) / 2


def channel(flow: str, across: int, *, scheme: WeaklyCompressible | None = None, backend: str = "auto") -> Simulation:
    """A channel of width 1 m at rest that starts to flow: "poiseuille" (driven by a force) or "couette" (by a wall).

    The largest speed of the steady flow is 1 m/s and nu = 0.1 m^2/s.

    Args:
        flow: which of the two.
        across: particles from wall to wall.
        scheme: None: the weakly compressible one with the options for channels.
        backend: name of the pair backend.

    Raises:
        ValueError: the flow is unknown.
    """
    if flow not in ("poiseuille", "couette"):
        raise ValueError(f"the flow must be 'poiseuille' or 'couette', got '{flow}'")
    spacing = 1 / across
    length, over = 16 * spacing, 8 * spacing
    surface = geometry.polygon(np.array([[-over, 0], [length + over, 0], [length + over, 1], [-over, 1]]), spacing)
    drive = np.where(np.isclose(surface.vertices[:, 1], 1.0), 1.0 if flow == "couette" else 0.0, 0.0)
    scene = Scene(
        spacing=spacing,
        fluid=Fluid(1.0, _CHANNEL_VISCOSITY),
        walls=_driven(surface, drive),
        period=(length, None),
        gravity=(8 * _CHANNEL_VISCOSITY if flow == "poiseuille" else 0.0, 0.0),
        dimension=2,
    )
    scheme = scheme or WeaklyCompressible(**exact_flows.CHANNEL_OPTIONS)
    return Simulator(scene, scheme, backend=backend, seeding=_LATTICE).start(0.0)


def channel_error(run: Simulation) -> float:
    """RMS error of the velocity along a ``channel``, m/s (the largest speed is 1 m/s), at the present time."""
    force, height = run.simulator.scene.gravity_at(run.time)[0], _points(run)[:, 1]
    if force:
        exact = exact_flows.poiseuille_start(height, run.time, _CHANNEL_VISCOSITY, force, 1.0)
    else:
        exact = exact_flows.couette_start(height, run.time, _CHANNEL_VISCOSITY, 1.0, 1.0)
    return float((run.particles.velocity[:, 0].double() - exact).square().mean().sqrt())


def lid_driven_cavity(across: int, reynolds: float, *, scheme: WeaklyCompressible | None = None) -> Simulation:
    """A square of 1 m at rest whose upper wall slides at 1 m/s (Ghia, Ghia & Shin 1982); nu = 1 / reynolds m^2/s."""
    spacing = 1 / across
    surface = geometry.polygon(np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), 0.5 * spacing)
    x, y = surface.vertices.T
    # the corners belong to the walls at rest: the lid must not drag fluid through them
    drive = np.where(np.isclose(y, 1.0) & ~np.isclose(x, 0.0) & ~np.isclose(x, 1.0), 1.0, 0.0)
    scene = Scene(spacing=spacing, fluid=Fluid(1.0, 1 / reynolds), walls=_driven(surface, drive), dimension=2)
    return Simulator(scene, scheme or WeaklyCompressible(**exact_flows.CAVITY_OPTIONS)).start(0.0)


def velocity_at(run: Simulation, points: np.ndarray) -> np.ndarray:
    """Velocity (n, D), m/s, at points (n, D), m, of a run of one member (reference speed 1 m/s)."""
    p, backend = run.particles, choose_backend(run.simulator.backend, run.simulator.device)
    at = torch.as_tensor(points / run.simulator.scene.spacing, dtype=p.position.dtype)
    member = torch.zeros(len(at), dtype=torch.int64)
    return (
        fetch_at(backend, at, member, p.position, p.member, p.velocity, FETCH_RADIUS, period=run.domain.period)
        .value.double()
        .numpy()
    )


def _driven(surface: geometry.Surface, speed: np.ndarray) -> geometry.WallMotion:
    """Walls that stand where they are while their vertices (nv,) slide along x, m/s."""
    rates = np.zeros_like(surface.vertices)
    rates[:, 0] = speed
    return geometry.WallMotion(np.zeros(1), surface.vertices[None], rates[None], surface.faces, surface.region)


def _points(run: Simulation) -> Tensor:
    return run.particles.position.double() * run.simulator.scene.spacing
