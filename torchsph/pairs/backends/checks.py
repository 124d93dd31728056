"""What arrays must be before their addresses go to compiled code, which reads and writes wherever it is told."""

from __future__ import annotations

import torch
from torch import Tensor

from ..interface import PairState

# slots, offsets of rows and the like are int32 in compiled code, with room for what fills up clusters
_MOST_PARTICLES = 2**28
# beyond the number of particles; every member has a table of its own, and most numbers this large are mistakes
_MOST_EMPTY_MEMBERS = 2**20


def expect(name: str, array: Tensor, shape: tuple[int, ...], dtype: torch.dtype | None = None) -> None:
    """ValueError or TypeError unless an array has a shape (-1: any length), and a type where one is given."""
    fits = array.ndim == len(shape) and all(
        wanted in (-1, length) for wanted, length in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("any" if length < 0 else str(length) for length in shape) + "," * (len(shape) == 1)
        raise ValueError(f"{name} must have the shape ({wanted}), got {tuple(array.shape)}")
    if dtype is not None and array.dtype != dtype:
        raise TypeError(f"{name} must be of {dtype}, got {array.dtype}")
    if array.layout != torch.strided:
        raise TypeError(f"{name} must be a dense tensor, got one of layout {array.layout}; use to_dense()")


def check_particles(position: Tensor, member: Tensor, names: tuple[str, str] = ("position", "member")) -> None:
    """ValueError or TypeError unless particles have places in the plane or in space, and member numbers.

    Args:
        position: (N, D).
        member: (N,) int64, not negative.
        names: what they are called.
    """
    if position.ndim != 2 or position.shape[1] not in (2, 3):
        raise ValueError(f"{names[0]} must have the shape (N, 2) or (N, 3), got {tuple(position.shape)}")
    count = position.shape[0]
    if count > _MOST_PARTICLES:
        raise ValueError(f"{count} particles are more than the {_MOST_PARTICLES} that an int32 can number here")
    expect(names[1], member, (count,), torch.int64)
    if member.device != position.device:
        raise ValueError(f"{names[1]} is on '{member.device}' and {names[0]} on '{position.device}'")
    last = int(member.max()) if count else 0
    if last > count + _MOST_EMPTY_MEMBERS:
        raise ValueError(f"{names[1]} says {last} for {count} particles; number the members from 0 on")


def check_period(period: Tensor | None, dimension: int) -> None:
    """ValueError unless a period is given for each axis, or none at all."""
    if period is not None:
        expect("period", period, (dimension,))


def check_shapes(state: PairState, dimension: int) -> None:
    """ValueError unless the arrays that every pass reads are of the particles; those of single terms have their own."""
    count = state.position.shape[0]
    for name, array, shape in (
        ("position", state.position, (count, dimension)),
        ("velocity", state.velocity, (count, dimension)),
        ("mass", state.mass, (count,)),
        ("deviation", state.deviation, (count,)),
    ):
        if array.shape != shape:
            expect(f"the state's {name}", array, shape)


def check_groups(group: Tensor, groups: int, count: int) -> None:
    """ValueError or TypeError unless every particle's group is one of those there are.

    Args:
        group: (N,) int64.
        groups: their number.
        count: N.
    """
    expect("group", group, (count,), torch.int64)
    if count:
        least, most = (int(value) for value in torch.aminmax(group))
        if least < 0 or most >= groups:
            raise ValueError(f"groups from {least} to {most}, but `singular` is of {groups}: 0 to {groups - 1}")
