"""Where the particles start: the thesis's Boltzmann sampling, or a packed, relaxed quiet start."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from geometry import WallMotion
from torchsph.pairs import choose_backend
from torchsph.pairs.interface import PairState, RateTerms, Support
from torchsph.pairs.smoothing_kernels import kernel

from .schemes.weakly_compressible import CompleteKernelWall, PotentialWall
from .state.neighbour_list import PairSearch
from .state.particles import FLUID, Particles
from .stepping.pressure import Neighbourhood, packing
from .walls.forces import potential

if TYPE_CHECKING:
    from .simulator import Simulator

_TRIES = 200
_LARGEST_MOVE = 0.1
# lattice points closer to the wall than this are left out; 0 would give exactly the rest density, but starts crowded
_CUT = 0.1
_CLEARANCE = 0.2


@dataclass(frozen=True)
class Seeding:
    """How particles are placed.

    Attributes:
        kind: "boltzmann": random positions accepted with exp(-(U - U0) / T) (section 3.1.4 and its erratum);
            "quiet": a lattice cut by the walls, then relaxed until the crowding gradient is small.
        temperature: T in units of the wall potential at d = 0 (boltzmann).
        relaxations: sweeps of the quiet start that move particles down the gradient of their crowding.
        packings: solves after them that even out the number density (``projection.packing``), open valves included.
        jitter: random displacement of lattice points, in spacings (quiet).
    """

    kind: str = "quiet"
    temperature: float = 0.1
    relaxations: int = 30
    packings: int = 3
    jitter: float = 0.02

    def __post_init__(self) -> None:
        if self.kind not in ("boltzmann", "quiet"):
            raise ValueError(f"Seeding.kind must be 'boltzmann' or 'quiet', got '{self.kind}'")
        if not self.temperature > 0 or min(self.relaxations, self.packings) < 0 or not 0 <= self.jitter < 0.5:
            raise ValueError(
                "Seeding needs temperature > 0, relaxations and packings >= 0 and 0 <= jitter < 0.5, got "
                f"{self.temperature}, {self.relaxations}, {self.packings}, {self.jitter}"
            )


def seed_particles(simulator: Simulator, time: float, generator: torch.Generator) -> Particles:
    """One member of resting fluid at rest density that fills the scene's walls, or its periodic box, at ``time`` (s).

    Raises ValueError where the scene has neither, or where the spacing leaves no room for a particle.
    """
    domain = simulator.domain
    soft = isinstance(simulator.scheme.wall, PotentialWall)
    seeding = simulator.seeding or Seeding("boltzmann" if soft and domain.walls is not None else "quiet")
    if domain.walls is None:
        position = _box_lattice(simulator, seeding, generator)
        return _resting(position, torch.ones_like(position[:, 0]))
    domain.enter(time, time, shut=True)
    lower, upper = _wall_box(simulator, time)
    place = _boltzmann if seeding.kind == "boltzmann" else _quiet
    position = place(simulator, seeding, lower, upper, generator)
    if position.shape[0] == 0:
        raise ValueError(
            f"no particle of spacing {simulator.scene.spacing:g} m fits inside the walls at {time:g} s; use a finer "
            "spacing"
        )
    volume = domain.fluid_volume(time) / simulator.scene.spacing**simulator.scene.dimension
    mass = torch.full_like(position[:, 0], volume / position.shape[0])
    resting = _resting(position, mass)
    if seeding.kind != "quiet" or soft or not seeding.packings:
        return resting
    return packed(simulator, resting, time, seeding.packings)


@dataclass(frozen=True)
class ResidualMotion:
    """How a fluid moves that should rest: RMS and largest speed of its particles, m/s."""

    rms: float
    largest: float


def residual_motion(simulator: Simulator, time: float, *, duration: float = 0.02, seed: int = 0) -> ResidualMotion:
    """What a start at ``time`` (s) leaves moving after ``duration`` (s), with walls held still and no forces or valves.

    None of it is flow: it is the noise floor of what is imposed on such a start.
    """
    walls = simulator.scene.walls
    still = None if walls is None else WallMotion.at_rest(walls.surface(time))
    scene = replace(simulator.scene, walls=still, valves=(), gravity=None)
    run = replace(simulator, scene=scene).start(0.0, seed=seed)
    run.advance(duration)
    speed = run.particles.velocity.double().norm(dim=1) * run.units.speed
    return ResidualMotion(float(speed.square().mean().sqrt()), float(speed.max()))


def _neighbours(simulator: Simulator) -> tuple[Support, PairSearch]:
    """The scheme's kernel and a search for its neighbours."""
    scheme = simulator.scheme
    support = Support(kernel(scheme.kernel), scheme.smoothing_ratio, simulator.scene.dimension)
    backend = choose_backend(simulator.backend, simulator.device)
    return support, PairSearch(backend, support.radius, 0.5, simulator.domain.period)


def packed(simulator: Simulator, particles: Particles, time: float, times: int) -> Particles:
    """Particles whose number density is evened out, the channels of valves that are open at ``time`` (s) included."""
    domain, (support, search) = simulator.domain, _neighbours(simulator)
    domain.enter(time, time)
    particles = domain.prepare(particles)
    for _ in range(times):
        here = Neighbourhood(particles, search, search.at(particles), support, domain.sample(particles))
        particles = particles.changed(position=particles.position + packing(here)[0])
        wall = domain.sample(particles)
        off = torch.where(particles.fluid, (_CLEARANCE - wall.distance).clamp_min(0.0), torch.zeros_like(wall.distance))
        particles = particles.changed(position=particles.position + off[:, None] * wall.normal)
    return particles


def _resting(position: Tensor, mass: Tensor) -> Particles:
    count = position.shape[0]
    label = torch.zeros(count, dtype=torch.int64, device=position.device)
    return Particles(position, torch.zeros_like(position), torch.zeros_like(mass), mass, label, label + FLUID, 1)


def _wall_box(simulator: Simulator, time: float) -> tuple[Tensor, Tensor]:
    vertices = torch.as_tensor(simulator.scene.walls.vertices(time), dtype=simulator.dtype, device=simulator.device)
    vertices = vertices / simulator.scene.spacing
    return vertices.amin(0), vertices.amax(0)


def _whole_periods(simulator: Simulator) -> list[int]:
    """Lattice points along each periodic axis, 0 along the others; ValueError where they do not fit."""
    counts = []
    for length in [] if simulator.domain.period is None else simulator.domain.period.tolist():
        counts.append(round(length) if math.isfinite(length) else 0)
        if counts[-1] and abs(length - counts[-1]) > 1e-3 * length:
            raise ValueError(f"a period of {length:g} spacings is not a whole number; change Scene.spacing")
    return counts


def _box_lattice(simulator: Simulator, seeding: Seeding, generator: torch.Generator) -> Tensor:
    period = simulator.domain.period
    if period is None or not bool(torch.isfinite(period).all()):
        raise ValueError("a scene without walls must be periodic in every direction to be seeded; else use resume()")
    position = _lattice(torch.zeros_like(period), _whole_periods(simulator))
    return position + seeding.jitter * (2 * _uniform(position, generator) - 1)


def _lattice(origin: Tensor, counts: list[int]) -> Tensor:
    axes = [origin[k] + torch.arange(n, device=origin.device, dtype=origin.dtype) + 0.5 for k, n in enumerate(counts)]
    return torch.cartesian_prod(*axes)


def _uniform(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.rand(like.shape, generator=generator, dtype=like.dtype, device=like.device)


def _boltzmann(
    simulator: Simulator, seeding: Seeding, lower: Tensor, upper: Tensor, generator: torch.Generator
) -> Tensor:
    """As many particles as rest volumes fit, one random try per unit cell and sweep (thesis 3.1.4).

    U0 is the potential of the free interior, 0. Points beyond the wall are refused whatever their potential.
    """
    model = simulator.scheme.wall
    if not isinstance(model, PotentialWall):
        raise ValueError("Boltzmann seeding needs a potential wall; use Seeding(kind='quiet')")
    sound = simulator.scheme.sound_speed / simulator.domain.units.speed
    scale = seeding.temperature * 0.5 * model.stiffness * sound**2
    origin = torch.floor(lower)
    counts = (torch.ceil(upper) - origin).to(torch.int64).tolist()
    for axis, count in enumerate(_whole_periods(simulator)):
        if count:
            origin[axis], counts[axis] = 0.0, count
    corner = _lattice(origin, counts) - 0.5
    # a vectorised sweep over cells, repeated where the try was refused, keeps about one particle per cell
    wall = simulator.domain.sample_at(corner + 0.5)
    open_cells = torch.nonzero(wall.distance > 0).squeeze(1)
    chosen = []
    for _ in range(_TRIES):
        if open_cells.numel() == 0:
            break
        trial = corner[open_cells] + _uniform(corner[open_cells], generator)
        wall = simulator.domain.sample_at(trial)
        chance = torch.exp(-potential(model, sound, wall) / scale) * (wall.distance > 0)
        taken = torch.rand(chance.shape, generator=generator, dtype=chance.dtype, device=chance.device) < chance
        chosen.append(trial[taken])
        open_cells = open_cells[~taken]
    return torch.cat(chosen) if chosen else corner[:0]


def _quiet(simulator: Simulator, seeding: Seeding, lower: Tensor, upper: Tensor, generator: torch.Generator) -> Tensor:
    """A lattice inside the walls, relaxed by shifting down the crowding gradient (Colagrossi et al. 2012)."""
    # centred: rows at uneven distances from opposite walls are a density gradient that no wall model can undo
    size = torch.ceil(upper - lower - 1e-3)
    counts, origin = size.to(torch.int64).tolist(), 0.5 * (lower + upper - size)
    for axis, count in enumerate(_whole_periods(simulator)):
        if count:
            origin[axis], counts[axis] = 0.0, count
    position = _lattice(origin, counts)
    position = position + seeding.jitter * (2 * _uniform(position, generator) - 1)
    position = position[simulator.domain.sample_at(position).distance > _CUT]
    if position.shape[0] == 0 or not isinstance(simulator.scheme.wall, CompleteKernelWall):
        return position
    volume = simulator.domain.fluid_volume(simulator.domain.middle) / simulator.scene.spacing ** position.shape[1]
    return relaxed(simulator, position, volume / position.shape[0], seeding.relaxations)


def relaxed(simulator: Simulator, position: Tensor, mass: float, sweeps: int) -> Tensor:
    """Move particles of volume ``mass`` (internal) down the gradient of their crowding, kept off the walls."""
    support, search = _neighbours(simulator)
    for _ in range(sweeps):
        particles = _resting(position, torch.full_like(position[:, 0], mass))
        state: PairState = particles.state(particles.deviation)
        terms = RateTerms(continuity=None, concentration=True)
        crowding = search.backend.rates(search.at(particles), state, support, terms).concentration
        wall = simulator.domain.sample_at(position)
        move = -0.15 * support.length**2 * (crowding - wall.share_gradient)
        length = move.norm(dim=1, keepdim=True)
        position = position + move * (_LARGEST_MOVE / length.clamp_min(_LARGEST_MOVE))
        wall = simulator.domain.sample_at(position)
        position = position + (_CLEARANCE - wall.distance).clamp_min(0.0)[:, None] * wall.normal
    return position
