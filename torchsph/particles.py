"""The flat set of particles of all ensemble members, in internal units."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from .pairs.interface import PairState

FLUID = 0
RESERVOIR = 1


@dataclass(frozen=True)
class Particles:
    """Particles of B members in one flat set (see ``Units`` for the units).

    Attributes:
        position: (N, D). velocity: (N, D).
        deviation: (N,), (rho - rho0) / rho0. mass: (N,), m / rho0 (a volume at rest density).
        member: (N,) int64, 0 <= member < members.
        kind: (N,) int64, FLUID, or RESERVOIR + v for a particle of the buffer of valve v.
        members: B.
    """

    position: Tensor
    velocity: Tensor
    deviation: Tensor
    mass: Tensor
    member: Tensor
    kind: Tensor
    members: int

    @property
    def count(self) -> int:
        """Particles of all members together."""
        return self.position.shape[0]

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.position.shape[1]

    @property
    def fluid(self) -> Tensor:
        """(N,) bool: particles of the fluid, not of a reservoir."""
        return self.kind == FLUID

    def changed(self, **values: Tensor) -> Particles:
        """A copy with some arrays replaced."""
        return replace(self, **values)

    def select(self, keep: Tensor) -> Particles:
        """The particles where ``keep`` (N,) bool, or the indices in ``keep``."""
        return replace(self, **{name: getattr(self, name)[keep] for name in _ARRAYS})

    def joined(self, other: Particles) -> Particles:
        """These particles followed by those of ``other``."""
        return replace(self, **{n: torch.cat([getattr(self, n), getattr(other, n)]) for n in _ARRAYS})

    def repeated(self, members: int) -> Particles:
        """``members`` copies of a single member, one after the other."""
        if self.members != 1:
            raise ValueError(f"only a single member can be repeated, this set has {self.members}")
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        copies = {n: value.repeat((members,) + (1,) * (value.ndim - 1)) for n, value in arrays.items()}
        member = torch.arange(members, device=self.member.device).repeat_interleave(self.count)
        return Particles(**{**copies, "member": member}, members=members)

    def state(self, pressure: Tensor) -> PairState:
        """What the pair passes read, with the pressure (N,) that belongs to it."""
        return PairState(self.position, self.velocity, self.mass, self.deviation, pressure, self.member)

    def per_member(self, values: Tensor, reduce: str, empty: float = 0.0) -> Tensor:
        """Reduce (N,) to (members,) with "sum", "amax" or "amin"; a member without particles gives ``empty``."""
        out = torch.full((self.members,), empty, dtype=values.dtype, device=values.device)
        return out.scatter_reduce(0, self.member, values, reduce, include_self=reduce == "sum")


_ARRAYS = tuple(f.name for f in fields(Particles) if f.name != "members")
