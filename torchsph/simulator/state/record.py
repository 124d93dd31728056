"""What a run did and what went wrong, per ensemble member: failure as data."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

import torch
from torch import Tensor

# what may limit a time step, in the order of ``stepping.terms.step_limits``
LIMITS = ("acoustic", "viscous", "force", "frame", "end of interval")
_DTYPES = {bool: torch.bool, int: torch.int64, float: torch.float64}


@dataclass(frozen=True)
class _Account:
    """One account: what it starts from, which gives its type too, and who reads it.

    Attributes:
        start: first value.
        by: None: one number a member; "valves", "limits": one for each of these as well.
        pooled: whether ``Record.totals`` sums it.
        taken_back: whether a stretch of the run that is taken back (``Rollback``) takes back what it added: it happened
            to the fluid, not to the computation.
    """

    start: float
    by: str | None = None
    pooled: bool = False
    taken_back: bool = False


def _account(
    start: float = 0, *, by: str | None = None, pooled: bool = False, taken_back: bool = False
) -> Any:  # as ``dataclasses.field``
    return field(init=False, metadata={"account": _Account(start, by, pooled, taken_back)})


@dataclass
class Record:
    """Accounts of a run.  All tensors (members,), counts int64, other numbers float64; speeds in m/s.

    A new account is one line below and one here: it is made, summed, taken back and shown from there.

    Attributes:
        members: number of members.
        valves: number of valves.
        device: of the tensors.
        steps: time steps taken.
        failed: a non-finite state appeared; the member is frozen at its last good state.
        smallest_density: over time and particles, relative to the rest density.
        largest_density: likewise.
        largest_mach: largest |v| / c.
        outside: particles beyond the wall now, in no open valve.
        crossed_wall: how often a particle was found beyond the wall and put back.
        inserted: particles that entered, by valve: (members, valves).
        removed: particles that left, by valve.
        inflow: volume that entered, by valve, m^D: (members, valves).
        outflow: volume that left, by valve.
        cavity_change: of the cavity's volume since the run began, m^D: what has to enter less what leaves.
        merged: particles that population control merged into others.
        reseeded: particles that it put into holes.
        energy_in: kinetic energy and work of pressure that entered, by valve, J (in a plane J/m): (members, valves).
        energy_out: what left of them, by valve.
        wall_work: done on the fluid by moving walls: pressure, friction and stops; J (in a plane J/m).
        source_work: done on the fluid by pressure sources, J (in a plane J/m).
        filling: volume of the particles inside over that of the cavity now; NaN in scenes without walls. Where a closed
            cavity changes its volume, it goes along: a weakly compressible fluid is compressed or thinned, and the
            incompressible scheme reports the mismatch below.
        volume_error: largest departure of the filling from that at the start, relative to it, in a scene with valves,
            where what enters and leaves should keep it (``failures.check_volume``).
        limited_by: how many steps each limit decided, (members, limits); names in ``LIMITS``.
        searches: neighbour searches, of all members together.
        reductions: how often a limit asked for a step shorter than the step before by more than a hundredth.
        floored: steps that the scheme's floor kept longer than the limits asked for; such a run may be unstable.
        rollbacks: how often the member went back to an earlier state to try again with shorter steps.
        overflows: searches made again because the lists outgrew their room, of all members together.
        pressure_iterations: of the solver of projections.
        unconverged: projections that ended without convergence.
        largest_mismatch: largest mean divergence, internal, that no pressure could answer (a closed cavity whose volume
            changes, or a flux that differs from it); it is spread evenly and so stays with the particles' volume.
    """

    members: int
    valves: int = 0
    device: str | torch.device = "cpu"
    steps: Tensor = _account(pooled=True)
    failed: Tensor = _account(False, pooled=True)
    smallest_density: Tensor = _account(1.0)
    largest_density: Tensor = _account(1.0)
    largest_mach: Tensor = _account(0.0)
    outside: Tensor = _account(pooled=True)
    crossed_wall: Tensor = _account(pooled=True, taken_back=True)
    inserted: Tensor = _account(by="valves", pooled=True, taken_back=True)
    removed: Tensor = _account(by="valves", pooled=True, taken_back=True)
    inflow: Tensor = _account(0.0, by="valves", taken_back=True)
    outflow: Tensor = _account(0.0, by="valves", taken_back=True)
    cavity_change: Tensor = _account(0.0)
    merged: Tensor = _account(pooled=True, taken_back=True)
    reseeded: Tensor = _account(pooled=True, taken_back=True)
    energy_in: Tensor = _account(0.0, by="valves", taken_back=True)
    energy_out: Tensor = _account(0.0, by="valves", taken_back=True)
    wall_work: Tensor = _account(0.0, taken_back=True)
    source_work: Tensor = _account(0.0, taken_back=True)
    filling: Tensor = _account(math.nan)
    volume_error: Tensor = _account(0.0)
    limited_by: Tensor = _account(by="limits")
    searches: int = field(default=0, init=False)
    reductions: Tensor = _account()
    floored: Tensor = _account()
    rollbacks: Tensor = _account()
    overflows: int = field(default=0, init=False)
    pressure_iterations: Tensor = _account()
    unconverged: Tensor = _account()
    largest_mismatch: Tensor = _account(0.0)

    def __post_init__(self) -> None:
        sizes = {None: (), "valves": (self.valves,), "limits": (len(LIMITS),)}
        for name, account in self._accounts().items():
            shape, dtype = (self.members, *sizes[account.by]), _DTYPES[type(account.start)]
            setattr(self, name, torch.full(shape, account.start, dtype=dtype, device=self.device))

    @classmethod
    def _accounts(cls) -> dict[str, _Account]:
        return {f.name: f.metadata["account"] for f in fields(cls) if "account" in f.metadata}

    def note_density(self, smallest: Tensor, largest: Tensor) -> None:
        """Widen the density range by deviations (members,) from the rest density."""
        self.smallest_density = torch.minimum(self.smallest_density, 1.0 + smallest.double())
        self.largest_density = torch.maximum(self.largest_density, 1.0 + largest.double())

    def kept(self) -> dict[str, Tensor]:
        """Copies of the accounts that are taken back with a stretch of the run, by name."""
        return {name: getattr(self, name).clone() for name, account in self._accounts().items() if account.taken_back}

    def take_back(self, member: int, kept: dict[str, Tensor]) -> None:
        """Put one member's accounts back to what they were when they were ``kept``."""
        for name, account in kept.items():
            getattr(self, name)[member] = account[member]

    def totals(self) -> dict[str, int]:
        """Sums over members, for pooling the accounts of several runs."""
        return {name: int(getattr(self, name).sum()) for name, account in self._accounts().items() if account.pooled}

    def summary(self) -> dict[str, object]:
        """Plain numbers for metrics files: lists over members."""
        shown: dict[str, object] = {}
        for name in (f.name for f in fields(self)):
            value = getattr(self, name)
            if name in ("members", "valves", "device", "largest_density"):
                continue
            if name == "smallest_density":
                shown["density_range"] = [value.tolist(), self.largest_density.tolist()]
            elif name == "limited_by":
                shown[name] = {limit: value[:, k].tolist() for k, limit in enumerate(LIMITS)}
            else:
                shown[name] = value.tolist() if isinstance(value, Tensor) else value
        return shown
