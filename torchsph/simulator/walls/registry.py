"""Which forces belong to which wall model: a new model is registered here, and nowhere else."""

from __future__ import annotations

from functools import singledispatch

from ..schemes.wall_models import CompleteKernelWall, PotentialWall
from .complete_kernel import CompleteKernelForces
from .interface import WallForces
from .potential import PotentialForces


@singledispatch
def wall_forces(model: object) -> WallForces:
    """What walls do to particles, by the options of their model.

    Raises:
        TypeError: ``model`` is of no type that is registered.
    """
    known = ", ".join(sorted(kind.__name__ for kind in registered_models()))
    raise TypeError(f"no forces are registered for walls of type {type(model).__name__}; known: {known}")


@wall_forces.register
def _(model: PotentialWall) -> WallForces:
    return PotentialForces(model)


@wall_forces.register
def _(model: CompleteKernelWall) -> WallForces:
    return CompleteKernelForces(model)


def registered_models() -> list[type]:
    """The types of options that walls can be made of."""
    return [kind for kind in wall_forces.registry if kind is not object]
