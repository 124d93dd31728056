"""The simulator: a scene and a scheme make running batches of members that advance together."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from geometry.arguments import checked
from torchsph.pairs import choose_backend
from torchsph.pairs.backends.differentiable import DifferentiableBackend

from .domain import Domain
from .scene import Scene
from .schemes.presets import preset
from .schemes.scheme import Scheme
from .seeding import Seeding, seed_particles
from .simulation import Simulation
from .state.checks import check_arrays, check_count, check_seed, check_time, check_values, usable_device
from .state.particles import Particles
from .state.units import Units


@checked
@dataclass(frozen=True)
class Simulator:
    """A scene with the way to step it.

    Args:
        scene: fluid, walls, valves, forces (SI).
        scheme: ``Projection`` or ``WeaklyCompressible`` options; None: the weakly compressible preset, for any scene.
        device: where particles live.
        dtype: in what precision (float32 or float64).
        backend: name of the pair backend, or "auto" for the best one present.
        seeding: how particles are placed; None takes what the scheme's walls call for.
        differentiable: whether torch can take gradients through imposing, advancing and fetching, in velocities,
            parameters and what a caller changes of the particles. Values and speed of a run without gradients stay as
            they are; see ``torchsph/README.md`` for the costs of one with gradients.
    """

    scene: Scene
    scheme: Scheme | None = None
    device: str = "cpu"
    dtype: torch.dtype = torch.float32
    backend: str = "auto"
    seeding: Seeding | None = None
    differentiable: bool = False
    _domain: Domain = field(init=False, repr=False, compare=False)
    # the last seeding: batches of an ensemble start from the same one, and making it takes as long as some steps
    _seeded: dict[tuple[float, int], Particles] = field(init=False, repr=False, compare=False, default_factory=dict)

    def __post_init__(self) -> None:
        scheme = preset("weakly_compressible") if self.scheme is None else self.scheme
        object.__setattr__(self, "scheme", scheme)
        if self.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"Simulator.dtype must be torch.float32 or torch.float64, got {self.dtype}")
        if self.scene.cut and scheme.compressible:
            raise ValueError(
                "a plane that is cut out of a flow in space needs the incompressible scheme (preset 'default')"
            )
        object.__setattr__(self, "device", usable_device(self.device))
        choose_backend(self.backend, self.device)  # a missing backend must not surface in the middle of a run
        units = Units(self.scene.spacing, self.scene.reference_speed)
        domain = Domain(self.scene, scheme, units, self.device, self.dtype)
        object.__setattr__(self, "_domain", domain)

    @property
    def domain(self) -> Domain:
        """Walls, valves and forces as particles see them; shared by all runs, and changed by none."""
        return self._domain

    @checked
    def start(self, time: float, *, members: int = 1, seed: int = 0) -> Simulation:
        """A resting fluid at ``time`` (s): ``members`` copies of one seeding, drawn with ``seed``.

        Raises:
            ValueError: no member, a time that is not finite or at which the wall is not known.
        """
        time = check_time(time, "time")
        members = check_count(members, "a simulation needs at least one member")
        label = (time, check_seed(seed))
        if label not in self._seeded:
            generator = torch.Generator(device=self.device).manual_seed(label[1])
            backend = choose_backend(self.backend, self.device)
            single = seed_particles(self.domain, backend, time, generator, self.seeding)
            self._seeded.clear()
            self._seeded[label] = single
        return self.resume(self._seeded[label].repeated(members), time)

    @checked
    def resume(self, particles: Particles, time: float) -> Simulation:
        """Run on with particles in internal units that were made elsewhere.

        A member with numbers that are not finite has failed, as one that a run lost: the others go on.

        Raises:
            TypeError: arrays that are no tensors, or of another type than the simulator's.
            ValueError: arrays that disagree in length, dimension or device; values that no run can step.
        """
        time = check_time(time, "time")
        check_arrays(particles, self.scene.dimension, self.dtype, self.device)
        check_values(particles, self.domain.valves.buffers)
        backend = choose_backend(self.backend, self.device)
        run = Simulation(
            self.domain, DifferentiableBackend(backend) if self.differentiable else backend, particles, time
        )
        run.simulator = self
        return run
