"""What a time step asks of the world around the particles, and what a run asks of what steps them."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from torch import Tensor

from torchsph.pairs.interface import Support

from ..state.neighbour_list import PairSearch
from ..state.particles import Particles
from ..state.record import Record
from ..walls.interface import WallSample
from .coefficients import Coefficients


class Surroundings(Protocol):
    """What a step asks about the world around the particles; times are those of the current step."""

    def sample(self, particles: Particles) -> WallSample | None:
        """Walls at the particles, or None where the scene has none."""

    def body_force(self, particles: Particles) -> Tensor | None:
        """Acceleration (N, D) by gravity and pressure sources, or None."""

    def volume_deficit_rate(self, particles: Particles) -> Tensor:
        """By how much (N,), per time, the volume of a member's particles should grow to fill the cavity."""

    def later(self, particles: Particles, step: Tensor) -> Particles:
        """Go on in time by ``step`` (members,); the particles with what reservoirs prescribe then."""


class Stepped(NamedTuple):
    """Particles after a step, and what the run still needs of it.

    Attributes:
        particles: at the end of the step.
        acceleration: (N, D), internal, of the fluid; the next step's force limit follows from it.
        wall: walls as the particles saw them at the start of the step, or None.
    """

    particles: Particles
    acceleration: Tensor
    wall: WallSample | None


class Stepper(Protocol):
    """Whatever steps particles with one scheme; it holds no state but the neighbour list and the coefficients in use.

    Attributes:
        pair_search: neighbour list of the run.
        support: kernel and smoothing length in use.
        coefficients: in use, internal units.
        prescribed_kinds: (n,) int64, ``Particles.kind`` of the buffers whose pressure is given, or None.
    """

    pair_search: PairSearch
    support: Support
    coefficients: Coefficients
    prescribed_kinds: Tensor | None

    def use(self, coefficients: Coefficients) -> None:
        """Step with these coefficients from now on."""

    def apart(self, coefficients: Coefficients, record: Record) -> Stepper:
        """A stepper like this one, with these coefficients, a neighbour list and an account of its own."""

    def pressure(self, particles: Particles) -> Tensor:
        """p / rho0 (N,), internal, of particles as they are."""

    def at_pressure(self, particles: Particles, row: Tensor, pressure: Tensor) -> Particles:
        """Particles whose ``row`` (n,) have ``pressure`` (n,), p / rho0, internal."""

    def step(self, particles: Particles, step: Tensor, number: Tensor, around: Surroundings) -> Stepped:
        """Advance every member by a step of its own.

        Args:
            particles: before the step.
            step: (members,), internal time; 0 for members that wait.
            number: (members,) int64, of the step in the run, from 1.
            around: walls, forces and reservoirs at the present time.
        """
