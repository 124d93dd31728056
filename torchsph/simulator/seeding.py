"""Where the particles start: Boltzmann sampling (Grønli 2017, sec. 3.1.4), or a packed, relaxed quiet start."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from geometry.arguments import checked
from torchsph.pairs.interface import Backend, RateTerms, Support
from torchsph.pairs.smoothing_kernels import kernel

from .domain import Domain
from .schemes.wall_models import PotentialWall
from .schemes.weakly_compressible import WeaklyCompressible
from .state.neighbour_list import PairSearch
from .state.particles import FLUID, Particles
from .state.required import required
from .stepping.pressure import Neighbourhood, packing
from .surroundings import PresentSurroundings
from .walls.interface import complete_sample
from .walls.potential import potential

_TRIES = 200
_LARGEST_MOVE = 0.1
# lattice points closer to the wall than this are left out; 0 would give exactly the rest density, but starts crowded
_CUT = 0.1
_CLEARANCE = 0.2


@checked
@dataclass(frozen=True)
class Seeding:
    """How particles are placed.

    Attributes:
        kind: "boltzmann": random positions accepted with exp(-(U - U0) / T) (Grønli 2017, sec. 3.1.4, with
            its erratum);
            "quiet": a lattice cut by the walls, then relaxed until the concentration gradient is small.
        temperature: T in units of the wall potential at d = 0 (boltzmann).
        relaxations: sweeps of the quiet start that move particles down the gradient of their concentration.
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


def seed_particles(
    domain: Domain, backend: Backend, time: float, generator: torch.Generator, seeding: Seeding | None = None
) -> Particles:
    """One member of resting fluid at rest density that fills the scene's walls, or its periodic box.

    Args:
        domain: of the scene.
        backend: for the sums over neighbours.
        time: s.
        generator: of the random numbers.
        seeding: how particles are placed; None takes what the scheme's walls call for.

    Raises:
        ValueError: the scene has neither walls nor a box, or the spacing leaves no room for a particle.
    """
    scene, soft = domain.scene, not domain.scheme.wall.complete
    seeding = seeding or Seeding("boltzmann" if soft and domain.walls is not None else "quiet")
    if domain.walls is None:
        position = _box_lattice(domain, seeding, generator)
        return _resting(position, torch.ones_like(position[:, 0]))
    surroundings = PresentSurroundings(domain)
    surroundings.enter(time, time, shut=True)
    if seeding.kind == "boltzmann":
        position = _boltzmann(surroundings, seeding, generator)
    else:
        position = _quiet(surroundings, backend, seeding, generator)
    if position.shape[0] == 0:
        raise ValueError(
            f"no particle of spacing {scene.spacing:g} m fits inside the walls at {time:g} s; use a finer spacing"
        )
    volume = domain.fluid_volume(time) / scene.spacing**scene.dimension
    resting = _resting(position, torch.full_like(position[:, 0], volume / position.shape[0]))
    if seeding.kind != "quiet" or soft or not seeding.packings:
        return resting
    return packed(surroundings, backend, resting, time, seeding.packings)


def _neighbours(domain: Domain, backend: Backend) -> tuple[Support, PairSearch]:
    """The scheme's kernel and a search for its neighbours."""
    scheme = domain.scheme
    support = Support(kernel(scheme.kernel), scheme.smoothing_ratio, domain.scene.dimension)
    return support, PairSearch(backend, support.radius, 0.5, domain.period)


def packed(
    surroundings: PresentSurroundings, backend: Backend, particles: Particles, time: float, times: int
) -> Particles:
    """Particles whose number density is evened out, the channels of valves that are open at ``time`` (s) included."""
    support, search = _neighbours(surroundings.domain, backend)
    surroundings.enter(time, time)
    particles = surroundings.prepare(particles)
    for _ in range(times):
        wall = surroundings.sample(particles)
        neighbourhood = Neighbourhood(particles, search, search.at(particles), support, wall)
        particles = particles.changed(position=particles.position + packing(neighbourhood)[0])
        wall = surroundings.sample_at(particles.position)
        off = torch.where(particles.fluid, (_CLEARANCE - wall.distance).clamp_min(0.0), torch.zeros_like(wall.distance))
        particles = particles.changed(position=particles.position + off[:, None] * wall.normal)
    return particles


def _resting(position: Tensor, mass: Tensor) -> Particles:
    count = position.shape[0]
    label = torch.zeros(count, dtype=torch.int64, device=position.device)
    return Particles(position, torch.zeros_like(position), torch.zeros_like(mass), mass, label, label + FLUID, 1)


def _wall_box(surroundings: PresentSurroundings) -> tuple[Tensor, Tensor]:
    """Lower and upper corner (D,), internal, of the walls in the middle of the present interval."""
    domain = surroundings.domain
    if domain.walls is None:
        raise ValueError("a scene without walls has no box around them")
    vertices = domain.walls.motion.vertices(surroundings.clock.middle)
    place = torch.as_tensor(vertices, dtype=domain.dtype, device=domain.device) / domain.scene.spacing
    return place.amin(0), place.amax(0)


def _whole_periods(domain: Domain) -> list[int]:
    """Lattice points along each periodic axis, 0 along the others; ValueError where they do not fit."""
    counts = []
    for length in [] if domain.period is None else domain.period.tolist():
        counts.append(round(length) if math.isfinite(length) else 0)
        if counts[-1] and abs(length - counts[-1]) > 1e-3 * length:
            raise ValueError(f"a period of {length:g} spacings is not a whole number; change Scene.spacing")
    return counts


def _box_lattice(domain: Domain, seeding: Seeding, generator: torch.Generator) -> Tensor:
    period = domain.period
    if period is None or not bool(torch.isfinite(period).all()):
        raise ValueError("a scene without walls must be periodic in every direction to be seeded; else use resume()")
    position = _lattice(torch.zeros_like(period), _whole_periods(domain))
    return position + seeding.jitter * (2 * _uniform(position, generator) - 1)


def _lattice(origin: Tensor, counts: list[int]) -> Tensor:
    axes = [origin[k] + torch.arange(n, device=origin.device, dtype=origin.dtype) + 0.5 for k, n in enumerate(counts)]
    return torch.cartesian_prod(*axes)


def _uniform(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.rand(like.shape, generator=generator, dtype=like.dtype, device=like.device)


def _boltzmann(surroundings: PresentSurroundings, seeding: Seeding, generator: torch.Generator) -> Tensor:
    """As many particles as rest volumes fit, one random try per unit cell and sweep (Grønli 2017, sec. 3.1.4).

    U0 is the potential of the free interior, 0. Points beyond the wall are refused whatever their potential.
    """
    domain = surroundings.domain
    scheme, model = domain.scheme, domain.scheme.wall
    if not isinstance(scheme, WeaklyCompressible) or not isinstance(model, PotentialWall):
        raise ValueError("Boltzmann seeding needs a potential wall; use Seeding(kind='quiet')")
    sound = scheme.sound_speed / domain.units.speed
    scale = seeding.temperature * 0.5 * model.stiffness * sound**2
    lower, upper = _wall_box(surroundings)
    origin = torch.floor(lower)
    counts = (torch.ceil(upper) - origin).to(torch.int64).tolist()
    for axis, count in enumerate(_whole_periods(domain)):
        if count:
            origin[axis], counts[axis] = 0.0, count
    corner = _lattice(origin, counts) - 0.5
    # a vectorised sweep over cells, repeated where the try was refused, keeps about one particle per cell
    wall = surroundings.sample_at(corner + 0.5)
    open_cells = torch.nonzero(wall.distance > 0).squeeze(1)
    chosen = []
    for _ in range(_TRIES):
        if open_cells.numel() == 0:
            break
        trial = corner[open_cells] + _uniform(corner[open_cells], generator)
        wall = surroundings.sample_at(trial)
        chance = torch.exp(-potential(model, sound, wall) / scale) * (wall.distance > 0)
        taken = torch.rand(chance.shape, generator=generator, dtype=chance.dtype, device=chance.device) < chance
        chosen.append(trial[taken])
        open_cells = open_cells[~taken]
    return torch.cat(chosen) if chosen else corner[:0]


def _quiet(surroundings: PresentSurroundings, backend: Backend, seeding: Seeding, generator: torch.Generator) -> Tensor:
    """A lattice inside the walls, relaxed by shifting down the concentration gradient (Colagrossi et al. 2012)."""
    domain, (lower, upper) = surroundings.domain, _wall_box(surroundings)
    # centred: rows at uneven distances from opposite walls are a density gradient that no wall model can undo
    size = torch.ceil(upper - lower - 1e-3)
    counts, origin = size.to(torch.int64).tolist(), 0.5 * (lower + upper - size)
    for axis, count in enumerate(_whole_periods(domain)):
        if count:
            origin[axis], counts[axis] = 0.0, count
    position = _lattice(origin, counts)
    position = position + seeding.jitter * (2 * _uniform(position, generator) - 1)
    position = position[surroundings.sample_at(position).distance > _CUT]
    if position.shape[0] == 0 or not domain.scheme.wall.complete:
        return position
    volume = domain.fluid_volume(surroundings.clock.middle) / domain.scene.spacing ** position.shape[1]
    return relaxed(surroundings, backend, position, volume / position.shape[0], seeding.relaxations)


def relaxed(surroundings: PresentSurroundings, backend: Backend, position: Tensor, mass: float, sweeps: int) -> Tensor:
    """Move particles of volume ``mass`` (internal) down the gradient of their concentration, kept off the walls."""
    support, search = _neighbours(surroundings.domain, backend)
    for _ in range(sweeps):
        particles = _resting(position, torch.full_like(position[:, 0], mass))
        state = particles.state(particles.deviation)
        terms = RateTerms(continuity=None, concentration=True)
        sums = search.backend.rates(search.at(particles), state, support, terms)
        gradient = required(sums.concentration, "the concentration gradient")
        wall = surroundings.sample_at(position)
        move = -0.15 * support.length**2 * (gradient - complete_sample(wall).completeness_gradient)
        length = move.norm(dim=1, keepdim=True)
        position = position + move * (_LARGEST_MOVE / length.clamp_min(_LARGEST_MOVE))
        wall = surroundings.sample_at(position)
        position = position + (_CLEARANCE - wall.distance).clamp_min(0.0)[:, None] * wall.normal
    return position
