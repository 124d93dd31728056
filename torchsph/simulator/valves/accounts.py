"""What passes through valves, for the record."""

from __future__ import annotations

import torch
from torch import Tensor

from ..state.energy import carried_energy, energy_unit
from ..state.particles import Particles
from ..state.record import Record
from ..state.units import Units


@torch.no_grad()  # an account, not a part of the flow
def note_passed(
    record: Record, passed: Particles, valve: int, pressure: Tensor, units: Units, density: float, *, entered: bool
) -> None:
    """Note number, volume and energy of particles that have gone through a valve.

    Args:
        record: where they are noted.
        passed: the particles.
        valve: its number.
        pressure: (n,) of the particles, p / rho0, internal.
        units: internal units.
        density: kg/m^3, of the fluid at rest.
        entered: whether they came in, or left.
    """
    if entered:
        count, volume, energy = record.inserted, record.inflow, record.energy_in
    else:
        count, volume, energy = record.removed, record.outflow, record.energy_out
    dimension = passed.dimension
    count[:, valve] += passed.per_member(torch.ones_like(passed.member), "sum")
    volume[:, valve] += passed.per_member(passed.mass.double(), "sum") * units.length**dimension
    carried = passed.per_member(carried_energy(passed, pressure), "sum")
    energy[:, valve] += carried * energy_unit(units, density, dimension)
