"""What a run did and what went wrong, per ensemble member: failure as data."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

# what may limit a time step, in the order of ``stepping.terms.step_limits``
LIMITS = ("acoustic", "viscous", "force", "frame", "end of interval")


@dataclass
class Record:
    """Accounts of a run.  All tensors (members,), counts int64; speeds in m/s.

    Attributes:
        steps: time steps taken. failed: a non-finite state appeared; the member is frozen at its last good state.
        smallest_density, largest_density: over time and particles, relative to the rest density.
        largest_mach: largest |v| / c.
        outside: particles beyond the wall now, in no open valve.
        crossed_wall: how often a particle was found beyond the wall and put back.
        inserted, removed: particles that entered and left, by valve: (members, valves).
        merged, reseeded: particles that population control merged into others, and that it put into holes.
        inflow, outflow: volume that entered and left, by valve, m^D (in a plane m^2): (members, valves).
        cavity_change: of the cavity's volume since the run began, m^D: what has to enter less what leaves.
        energy_in, energy_out: kinetic energy and work of pressure that entered and left with it, by valve, J (in a
            plane J/m): (members, valves).
        wall_work: done on the fluid by moving walls: pressure, friction and stops; J (in a plane J/m).
        source_work: done on the fluid by pressure sources, J (in a plane J/m).
        filling: volume of the particles inside over that of the cavity now; NaN in scenes without walls. Where a closed
            cavity changes its volume, it goes along: a weakly compressible fluid is compressed or thinned, and the
            incompressible scheme reports the mismatch below.
        limited_by: how many steps each limit decided, (members, limits); names in ``LIMITS``.
        reductions: how often a limit asked for a step shorter than the step before by more than a hundredth.
        floored: steps that the scheme's floor kept longer than the limits asked for; such a run may be unstable.
        pressure_iterations: of the solver of projections. unconverged: projections that ended without convergence.
        largest_mismatch: largest mean divergence, internal, that no pressure could answer (a closed cavity whose volume
            changes, or a flux that differs from it); it is spread evenly and so stays with the particles' volume.
        rollbacks: how often the member went back to an earlier state to try again with shorter steps.
        searches, overflows: neighbour searches, and those made again because the lists outgrew their room; both of all
            members together.
    """

    members: int
    valves: int = 0
    device: str | torch.device = "cpu"
    searches: int = 0
    overflows: int = 0
    steps: Tensor = field(init=False)
    failed: Tensor = field(init=False)
    smallest_density: Tensor = field(init=False)
    largest_density: Tensor = field(init=False)
    largest_mach: Tensor = field(init=False)
    outside: Tensor = field(init=False)
    crossed_wall: Tensor = field(init=False)
    inserted: Tensor = field(init=False)
    removed: Tensor = field(init=False)
    merged: Tensor = field(init=False)
    reseeded: Tensor = field(init=False)
    inflow: Tensor = field(init=False)
    outflow: Tensor = field(init=False)
    cavity_change: Tensor = field(init=False)
    energy_in: Tensor = field(init=False)
    energy_out: Tensor = field(init=False)
    wall_work: Tensor = field(init=False)
    source_work: Tensor = field(init=False)
    filling: Tensor = field(init=False)
    limited_by: Tensor = field(init=False)
    reductions: Tensor = field(init=False)
    floored: Tensor = field(init=False)
    rollbacks: Tensor = field(init=False)
    pressure_iterations: Tensor = field(init=False)
    unconverged: Tensor = field(init=False)
    largest_mismatch: Tensor = field(init=False)

    def __post_init__(self) -> None:
        def counts(*shape: int) -> Tensor:
            return torch.zeros((self.members, *shape), dtype=torch.int64, device=self.device)

        self.steps, self.outside, self.crossed_wall = counts(), counts(), counts()
        self.reductions, self.floored, self.rollbacks = counts(), counts(), counts()
        self.pressure_iterations, self.unconverged = counts(), counts()
        self.merged, self.reseeded = counts(), counts()
        self.inserted, self.removed, self.limited_by = counts(self.valves), counts(self.valves), counts(len(LIMITS))
        self.failed = torch.zeros(self.members, dtype=torch.bool, device=self.device)
        one = torch.ones(self.members, dtype=torch.float64, device=self.device)
        self.smallest_density, self.largest_density = one.clone(), one.clone()
        self.inflow, self.outflow, self.energy_in, self.energy_out = (
            one[:, None].repeat(1, self.valves) * 0.0 for _ in range(4)
        )
        self.filling = one * float("nan")
        self.largest_mach, self.largest_mismatch, self.cavity_change, self.wall_work, self.source_work = (
            torch.zeros_like(one) for _ in range(5)
        )

    def note_density(self, smallest: Tensor, largest: Tensor) -> None:
        """Widen the density range by deviations (members,) from the rest density."""
        self.smallest_density = torch.minimum(self.smallest_density, 1.0 + smallest.double())
        self.largest_density = torch.maximum(self.largest_density, 1.0 + largest.double())

    def totals(self) -> dict[str, int]:
        """Sums over members, for pooling the accounts of several runs."""
        return {
            "steps": int(self.steps.sum()),
            "failed": int(self.failed.sum()),
            "outside": int(self.outside.sum()),
            "crossed_wall": int(self.crossed_wall.sum()),
            "inserted": int(self.inserted.sum()),
            "removed": int(self.removed.sum()),
            "merged": int(self.merged.sum()),
            "reseeded": int(self.reseeded.sum()),
        }

    def summary(self) -> dict[str, object]:
        """Plain numbers for metrics files: lists over members."""
        steps = {name: self.limited_by[:, k].tolist() for k, name in enumerate(LIMITS)}
        return {
            "steps": self.steps.tolist(),
            "failed": self.failed.tolist(),
            "density_range": [self.smallest_density.tolist(), self.largest_density.tolist()],
            "largest_mach": self.largest_mach.tolist(),
            "outside": self.outside.tolist(),
            "crossed_wall": self.crossed_wall.tolist(),
            "inserted": self.inserted.tolist(),
            "removed": self.removed.tolist(),
            "inflow": self.inflow.tolist(),
            "outflow": self.outflow.tolist(),
            "cavity_change": self.cavity_change.tolist(),
            "merged": self.merged.tolist(),
            "reseeded": self.reseeded.tolist(),
            "energy_in": self.energy_in.tolist(),
            "energy_out": self.energy_out.tolist(),
            "wall_work": self.wall_work.tolist(),
            "source_work": self.source_work.tolist(),
            "filling": self.filling.tolist(),
            "limited_by": steps,
            "searches": self.searches,
            "reductions": self.reductions.tolist(),
            "floored": self.floored.tolist(),
            "rollbacks": self.rollbacks.tolist(),
            "overflows": self.overflows,
            "pressure_iterations": self.pressure_iterations.tolist(),
            "unconverged": self.unconverged.tolist(),
            "largest_mismatch": self.largest_mismatch.tolist(),
        }
