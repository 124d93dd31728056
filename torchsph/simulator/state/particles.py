"""The flat set of particles of all ensemble members, in internal units."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchsph.pairs.interface import PairState

FLUID = 0
RESERVOIR = 1
CHANNEL = -1


@dataclass(frozen=True)
class Particles:
    """Particles of B members in one flat set (see ``Units`` for the units).

    Attributes:
        position: (N, D).
        velocity: (N, D).
        deviation: (N,), (rho - rho0) / rho0.
        mass: (N,), m / rho0 (a volume at rest density).
        member: (N,) int64, 0 <= member < members.
        kind: (N,) int64, FLUID; RESERVOIR + v for a particle of the buffer of opening v, whose velocity is prescribed;
            CHANNEL - v for one that has left through opening v and still moves freely.
        members: B.
        label: (N,) int64, a numbering that survives sorting, or None.
        confidence: (N,), not negative, what a particle's velocity counts for in XSPH and in fetching; None: all alike.
        pressure: (N,), p / rho0 of the last projection, or None (schemes without one).
        exchange: (N,), rate at which volume comes in through a plane that is cut out of a flow, or None.
        origin: (N, D), where each was when somebody began to follow them (``Simulation.follow``), or None. Of a
            particle that came later: where it came in.
    """

    position: Tensor
    velocity: Tensor
    deviation: Tensor
    mass: Tensor
    member: Tensor
    kind: Tensor
    members: int
    label: Tensor | None = None
    confidence: Tensor | None = None
    pressure: Tensor | None = None
    exchange: Tensor | None = None
    origin: Tensor | None = None

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
        """(N,) bool: particles that move freely, those in the channel behind an outlet included."""
        return self.kind <= FLUID

    @property
    def inside(self) -> Tensor:
        """(N,) bool: particles of the fluid within the walls."""
        return self.kind == FLUID

    def changed(self, **values: Tensor) -> Particles:
        """A copy with some arrays replaced."""
        # every step asks a dozen times; ``dataclasses.replace`` takes four times as long over it
        unknown = values.keys() - self.__dict__.keys()
        if unknown:
            raise TypeError(f"particles have no {', '.join(sorted(unknown))}")
        copy = object.__new__(Particles)
        copy.__dict__.update(self.__dict__, **values)
        return copy

    def select(self, keep: Tensor) -> Particles:
        """The particles where ``keep`` (N,) bool, or the indices in ``keep``."""
        # the places are looked up once for all arrays: each time the processor has to wait for a GPU
        rows = torch.nonzero(keep).squeeze(1) if keep.dtype == torch.bool else keep
        return self.changed(**{name: value[rows] for name, value in self.arrays().items()})

    def joined(self, other: Particles) -> Particles:
        """These particles followed by those of ``other``; where they lack them these get labels and full confidence."""
        theirs = other.arrays()
        if self.label is not None and other.label is None:
            first = int(self.label.max()) + 1 if self.count else 0
            theirs["label"] = torch.arange(first, first + other.count, device=self.label.device)
        if other.confidence is None:
            theirs["confidence"] = torch.ones_like(other.mass)
        if other.pressure is None:
            theirs["pressure"] = torch.zeros_like(other.mass)
        if other.exchange is None:
            theirs["exchange"] = torch.zeros_like(other.mass)
        if other.origin is None:
            theirs["origin"] = other.position
        return self.changed(**{name: torch.cat([value, theirs[name]]) for name, value in self.arrays().items()})

    def repeated(self, members: int) -> Particles:
        """``members`` copies of a single member, one after the other, without labels."""
        if self.members != 1:
            raise ValueError(f"only a single member can be repeated, this set has {self.members}")
        copies = {n: value.repeat((members,) + (1,) * (value.ndim - 1)) for n, value in self.arrays().items()}
        copies["member"] = torch.arange(members, device=self.member.device).repeat_interleave(self.count)
        return replace(self.changed(**copies), members=members, label=None)

    def with_member(self, member: int, other: Particles) -> tuple[Particles, Tensor]:
        """Particles whose ``member`` is as in ``other``, and where they come from: rows (N,) of the two joined.

        They stand where they stood if they are as many, else behind the others, whose order stays.
        """
        old = torch.nonzero(self.member == member).flatten()
        new = torch.nonzero(other.member == member).flatten()
        if self.label is not None and other.label is not None:  # each particle back into its own row
            old, new = old[torch.argsort(self.label[old])], new[torch.argsort(other.label[new])]
        new = new + self.count
        rows = torch.arange(self.count, device=self.member.device)
        if len(old) == len(new):
            rows[old] = new
        else:
            rows = torch.cat([rows[self.member != member], new])
        return self.joined(other).select(rows), rows

    def labelled(self) -> Particles:
        """With labels 0, 1, ... in the present order."""
        return replace(self, label=torch.arange(self.count, device=self.member.device))

    def by_label(self) -> Particles:
        """In the order of the labels, and without them.

        Raises:
            ValueError: the particles have none.
        """
        if self.label is None:
            raise ValueError("particles without labels cannot be put in their order")
        return replace(self.select(torch.argsort(self.label, stable=True)), label=None)

    def arrays(self) -> dict[str, Tensor]:
        """Everything that has one row a particle."""
        found = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "members"}
        return {name: value for name, value in found.items() if value is not None}

    def state(self, pressure: Tensor) -> PairState:
        """What the pair passes read, with the pressure (N,) that belongs to it."""
        return PairState(self.position, self.velocity, self.mass, self.deviation, pressure, self.member)

    def per_member(self, values: Tensor, reduce: str, empty: float = 0.0) -> Tensor:
        """Reduce (N,) to (members,) with "sum", "amax" or "amin"; a member without particles gives ``empty``."""
        if self.members == 1 and self.count and reduce != "sum":  # six times as fast as the general way
            return getattr(values, reduce)()[None]
        out = torch.full((self.members,), empty, dtype=values.dtype, device=values.device)
        return out.scatter_reduce(0, self.member, values, reduce, include_self=reduce == "sum")


def rows_frozen(members: Tensor, particles: Particles, before: Tensor, after: Tensor) -> Tensor:
    """``before`` for the particles of some members (members,) bool, ``after`` for the others; (N, ...)."""
    frozen = members[particles.member]
    return torch.where(frozen.reshape(-1, *[1] * (after.ndim - 1)), before, after)


def frozen(members: Tensor, before: Particles, after: Particles) -> Particles:
    """``after`` with the state of some members (members,) bool as it was before."""
    keep = {n: getattr(after, n) for n in ("position", "velocity", "deviation")}
    if before.pressure is not None:
        keep["pressure"] = after.pressure
    if before.exchange is not None:
        keep["mass"] = after.mass
    return after.changed(**{n: rows_frozen(members, after, getattr(before, n), value) for n, value in keep.items()})
