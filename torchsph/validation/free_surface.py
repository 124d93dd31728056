"""What scenes with a free surface need: a resting block of fluid in a larger cavity, and pressure probes on walls."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchsph.pairs import choose_backend
from torchsph.pairs.interface import Support
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.simulator.schemes.weakly_compressible import WeaklyCompressible
from torchsph.simulator.simulation import Simulation
from torchsph.simulator.simulator import Simulator
from torchsph.simulator.state.particles import FLUID, Particles
from torchsph.simulator.stepping.terms import tait_pressure

# a probe whose kernel is filled less than this is dry: half a kernel is all that a wall leaves, an edge a quarter
_WET_PART = 0.1


def resting_block(simulator: Simulator, lower: Sequence[float], upper: Sequence[float]) -> Particles:
    """One member of resting fluid at rest density in the box from ``lower`` to ``upper`` (D,), m.

    The particles stand on a lattice, half a spacing inside the sides; ``Simulator.resume`` runs them.

    Args:
        simulator: of the scene and scheme.
        lower: (D,), m.
        upper: (D,), m.

    Raises:
        ValueError: a side is not a whole number of spacings, within a hundredth of one.
    """
    scene = simulator.scene
    if not len(lower) == len(upper) == scene.dimension:
        raise ValueError(f"a block needs corners of {scene.dimension} entries, got {len(lower)} and {len(upper)}")
    axes = []
    for low, high in zip(lower, upper, strict=True):
        length = (high - low) / scene.spacing
        if round(length) < 1 or abs(length - round(length)) > 0.01:
            raise ValueError(
                f"a side from {low:g} to {high:g} m is {length:.3f} spacings; a block needs whole numbers, 1 or more"
            )
        count = torch.arange(round(length), dtype=simulator.dtype, device=simulator.device)
        axes.append(low / scene.spacing + count + 0.5)
    position = torch.cartesian_prod(*axes)
    label = torch.zeros(position.shape[0], dtype=torch.int64, device=simulator.device)
    mass = torch.ones_like(position[:, 0])
    return Particles(position, torch.zeros_like(position), torch.zeros_like(mass), mass, label, label + FLUID, 1)


def wall_pressure(run: Simulation, points: Tensor) -> Tensor:
    """Pressure at points on walls; 0 where a probe is dry.

    The mean over the particles around with the scheme's kernel as weight (Shepard 1968), which a wall that cuts the
    kernel does not bias towards 0. Tension counts as 0: a sheet of water leaves a probe rather than pull at it.

    Args:
        run: of the weakly compressible scheme.
        points: (n, D), m.

    Returns:
        (members, n) float64, Pa.

    Raises:
        ValueError: the scheme is incompressible, so that its pressure is none of the density's.
    """
    simulator, p, units = run.simulator, run.particles, run.units
    scheme = simulator.scheme
    if not isinstance(scheme, WeaklyCompressible):
        raise ValueError("pressure on walls is read off the density: it needs the weakly compressible scheme")
    backend = choose_backend(simulator.backend, simulator.device)
    support = Support(kernel(scheme.kernel), scheme.smoothing_ratio, p.dimension)
    query = (points.to(p.position) / units.length).repeat(p.members, 1)
    owner = torch.arange(p.members, device=p.member.device).repeat_interleave(len(points))
    pressure = tait_pressure(p.deviation, scheme.sound_speed / units.speed, scheme.gamma).clamp_min(0.0)
    fields = torch.stack([pressure, p.mass / (1.0 + p.deviation)], 1)
    found = backend.interpolate(p.position, p.member, fields, support, query, owner, period=run.domain.period)
    mean = found.field[:, 0] / found.value.clamp_min(torch.finfo(found.value.dtype).tiny)
    wet = torch.where(found.field[:, 1] > _WET_PART, mean, torch.zeros_like(mean)).double()
    return wet.reshape(p.members, len(points)) * simulator.scene.fluid.density * units.speed**2
