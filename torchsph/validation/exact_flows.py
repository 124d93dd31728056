"""Flows with known solutions, for tests and benchmarks: Taylor-Green, channel start-up."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsph.simulator.schemes.wall_models import CompleteKernelWall

from .options import ProjectionOptions, WeaklyCompressibleOptions

# of the series of plane flows started from rest
_PLANE_TERMS = 200


def taylor_green_2d(points: Tensor, time: float, viscosity: float, speed: float = 1.0, length: float = 1.0) -> Tensor:
    """Velocity (n, 2), m/s, of the decaying vortex array (Taylor & Green 1937) at points (n, 2), m.

    u = -U exp(-8 pi^2 nu t / L^2) cos(2 pi x / L) sin(2 pi y / L), v its mirror image.

    Args:
        points: (n, 2), m.
        time: s.
        viscosity: kinematic, m^2/s.
        speed: U, m/s.
        length: period L, m.
    """
    x, y = (2 * math.pi * points / length).unbind(1)
    decay = speed * math.exp(-8 * math.pi**2 * viscosity * time / length**2)
    return decay * torch.stack([-torch.cos(x) * torch.sin(y), torch.sin(x) * torch.cos(y)], 1)


def taylor_green_2d_pressure(
    points: Tensor, time: float, viscosity: float, speed: float = 1.0, length: float = 1.0
) -> Tensor:
    """p / rho (n,), m^2/s^2, of ``taylor_green_2d``: -U^2/4 exp(-16 pi^2 nu t / L^2) (cos 2kx + cos 2ky).

    Arguments as for the velocity.
    """
    x, y = (2 * math.pi * points / length).unbind(1)
    decay = speed**2 * math.exp(-16 * math.pi**2 * viscosity * time / length**2)
    return -0.25 * decay * (torch.cos(2 * x) + torch.cos(2 * y))


def taylor_green_3d(points: Tensor, speed: float = 1.0, length: float = 2 * math.pi) -> Tensor:
    """Initial velocity (n, 3), m/s, of the vortex in space (Brachet et al. 1983, eq. 1.1)."""
    x, y, z = (2 * math.pi * points / length).unbind(1)
    u = torch.sin(x) * torch.cos(y) * torch.cos(z)
    v = -torch.cos(x) * torch.sin(y) * torch.cos(z)
    return speed * torch.stack([u, v, torch.zeros_like(u)], 1)


def taylor_green_3d_pressure(points: Tensor, speed: float = 1.0, length: float = 2 * math.pi) -> Tensor:
    """p / rho (n,), m^2/s^2, of ``taylor_green_3d`` at the start: U^2/16 (cos 2x + cos 2y)(cos 2z + 2)."""
    x, y, z = (4 * math.pi * points / length).unbind(1)
    return speed**2 / 16 * (torch.cos(x) + torch.cos(y)) * (torch.cos(z) + 2.0)


def poiseuille_start(height: Tensor, time: float, viscosity: float, force: float, width: float) -> Tensor:
    """Velocity (n,), m/s, of plane Poiseuille flow started from rest (Morris, Fox & Zhu 1997, eq. 34).

    Args:
        height: (n,), distance from one wall, m.
        time: since the start, s.
        viscosity: kinematic, m^2/s.
        force: acceleration, m/s^2.
        width: between the walls, m.
    """
    steady = force / (2 * viscosity) * height * (width - height)
    odd = 2.0 * torch.arange(_PLANE_TERMS, dtype=height.dtype, device=height.device) + 1.0
    decay = torch.exp(-(odd**2) * math.pi**2 * viscosity * time / width**2)
    terms = 4 * force * width**2 / (viscosity * math.pi**3 * odd**3) * decay
    return steady - torch.sin(math.pi * height[:, None] / width * odd) @ terms


def couette_start(height: Tensor, time: float, viscosity: float, speed: float, width: float) -> Tensor:
    """Velocity (n,), m/s, of plane Couette flow started from rest (Morris, Fox & Zhu 1997, eq. 33).

    Args:
        height: (n,), distance from the wall at rest, m.
        time: since the start, s.
        viscosity: kinematic, m^2/s.
        speed: of the wall at ``width``, m/s.
        width: between the walls, m.
    """
    order = torch.arange(1, _PLANE_TERMS + 1, dtype=height.dtype, device=height.device)
    decay = torch.exp(-(order**2) * math.pi**2 * viscosity * time / width**2)
    terms = 2 * speed / (math.pi * order) * torch.cos(math.pi * order) * decay
    return speed * height / width + torch.sin(math.pi * height[:, None] / width * order) @ terms


def observed_order(spacings: list[float], errors: list[float]) -> float:
    """Slope of log(error) over log(spacing) by least squares: the order of convergence."""
    h, e = torch.tensor(spacings, dtype=torch.float64).log(), torch.tensor(errors, dtype=torch.float64).log()
    h = h - h.mean()
    return float((h * (e - e.mean())).sum() / (h * h).sum())


# Changes of the weakly compressible preset for flows it was not chosen for, each measured in
# tests/torchsph/validation or tests/torchsph/simulator/test_hard_cases.py.
#
# Vortices: what dissipates is not viscosity but disorder: the lattice breaks up along the strained directions, pressure
# forces on uneven particles stir them, and viscosity consumes what is stirred. Switching bulk damping, density
# diffusion or the pressure form changes nothing; even particles do. Without shifting a 3-D vortex at Re 100 on 24^3
# particles has lost 34 % of its kinetic energy at t = 5, with strength 8 10 %, with strength 16 and h = 1.8 0.4 %. At a
# tenth of the speed of sound, strength 16 is a shift of h^2 / 2 grad C per step, Lind et al.'s limit of stability.
PERIODIC_OPTIONS: WeaklyCompressibleOptions = {
    "smoothing_ratio": 2.0,
    "sound_speed": 10.0,
    "pressure": "sum",
    "artificial_viscosity": None,
    "shifting": 16.0,
    "shifting_speed": "largest",
    "order": "verlet",
}
# in space h = 2 costs a third more and its kernel smooths the viscous forces by 2 % at Re 50 on 24^3
PERIODIC_OPTIONS_3D: WeaklyCompressibleOptions = {**PERIODIC_OPTIONS, "smoothing_ratio": 1.8}
# Incompressible steps: a shorter relaxation stirs the fluid (3 % instead of .5 % at 60^2), weaker shifting leaves
# disorder. On 20^2 particles the step is too long (6 %); a Courant fraction of 0.2 gives 3 % there, and more elsewhere.
PERIODIC_PROJECTION: ProjectionOptions = {
    "relaxation": 6.0,
    "shifting": 4.0,
    "courant": 0.4,
    "tolerance": 1.25e-2,
    "max_step": None,
    "longest_step": None,
}
# In space the shape of the vortices changes all the time and the step is what counts: 24^3 at Re 100 lose 10 % of their
# kinetic energy too much with the fraction of the plane, 1 % with this one, which is still half of the time above.
PERIODIC_PROJECTION_3D: ProjectionOptions = {**PERIODIC_PROJECTION, "relaxation": 2.0, "courant": 0.1}
CHANNEL_OPTIONS: WeaklyCompressibleOptions = {"smoothing_ratio": 2.0, "sound_speed": 10.0, "artificial_viscosity": None}
# Closed boxes that are stirred: pressures of both signs last there, and only the difference form is exact for either;
# it needs more diffusion of the density (delta-SPH's 0.1 leaves noise in the corners).
CAVITY_OPTIONS: WeaklyCompressibleOptions = {
    "smoothing_ratio": 2.0,
    "sound_speed": 10.0,
    "pressure": "difference",
    "artificial_viscosity": None,
    "density_diffusion": 0.3,
    "shifting": 16.0,
    "shifting_speed": "largest",
    "constant_volume": True,
    "wall": CompleteKernelWall(sliding=True),
}
# Free surfaces: the switched pressure form is not conservative and feeds energy into a surface under tension (Sun et
# al. 2017 keep the sum there), and shifting pushes particles out of it. Drops of a few particles under tension would
# spin out of hand.
FREE_SURFACE_OPTIONS: WeaklyCompressibleOptions = {
    "pressure": "sum",
    "shifting": None,
    "sound_speed": 10.0,
    "least_density": 0.5,
}
# A stretched fluid (a rotating patch) tears from tensile instability by omega t = 1 unless it is evened out below its
# surface; where a vacuum shall open, this shifting would fill it.
STRETCHED_SURFACE_OPTIONS: WeaklyCompressibleOptions = {
    **FREE_SURFACE_OPTIONS,
    "shifting": 4.0,
    "shifting_speed": "largest",
    "shifting_surface": 0.15,
}
