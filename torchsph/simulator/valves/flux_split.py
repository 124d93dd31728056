"""How the volume that a cavity takes in is split between openings that are open at once.

What the openings pass together is dV/dt, exactly (continuity); how each takes part is a state of the flow. It is read
off the velocity field that was imposed on a run, and goes on from there: openings keep the differences between their
fluxes, and share what dV/dt changes by in proportion to what they carry. A leak that carries a quarter of the filling
so stays a quarter of it, and a steady flow through a vessel that keeps its volume stays steady. Where nothing was
read, openings share by the area that is open. A valve with a given flux takes no part: the others take what it leaves.
Where none is left to, fluxes that are given with an error are moved by their variances until the sum is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..state.clock import Clock
from .openings import OpeningPlane, Openings

# an opening that carries nothing takes this part, by its area, in what the others carry: so that none divides by nought
_LEAST = 1e-3
# exact fluxes may miss their sum by this part of the largest: round-off of tables, not a source that nothing answers
_UNANSWERED = 1e-2


@dataclass(frozen=True, eq=False)
class FluxSplit:
    """What a run's openings carried at one time.

    Attributes:
        numbers: of the openings.
        flux: (members, len(numbers)), internal, inwards.
    """

    numbers: tuple[int, ...]
    flux: Tensor

    @classmethod
    def balanced(cls, numbers: tuple[int, ...], flux: Tensor, areas: Tensor, total: Tensor) -> FluxSplit:
        """Fluxes (members, n) as they were read, brought to sum to ``total`` (members,) by what each carries."""
        return cls(numbers, flux + (total - flux.sum(1))[:, None] * _parts(flux, areas))

    def at(self, numbers: tuple[int, ...], areas: Tensor, total: Tensor) -> Tensor:
        """Fluxes (members, n) of some of the openings that sum to ``total`` (members,)."""
        column = [self.numbers.index(number) for number in numbers]
        flux = self.flux[:, column]
        return flux + (total - flux.sum(1))[:, None] * _parts(flux, areas)


def _parts(flux: Tensor, areas: Tensor) -> Tensor:
    """Parts (members, n), of sum 1, in which a difference is shared: by size of the fluxes, else by area."""
    size, by_area = flux.abs(), areas / areas.sum()
    carried = size + _LEAST * size.sum(1, keepdim=True) * by_area
    total = carried.sum(1, keepdim=True)
    return torch.where(total > 0, carried / total.clamp_min(torch.finfo(flux.dtype).tiny), by_area)


def takers(openings: Openings, active: list[tuple[int, OpeningPlane]]) -> list[tuple[int, OpeningPlane]]:
    """The open openings whose flux is not given, directly or by a pressure."""
    return [(n, plane) for n, plane in active if n not in openings.given and openings.valve(n).flux is None]


def fluxes(openings: Openings, clock: Clock, total: Tensor, *, time: float | None = None) -> dict[int, Tensor]:
    """Flux inwards (members,), internal, through each opening that is open and at no given pressure.

    Args:
        openings: of the scene's valves.
        clock: the present time, and the split that was read.
        total: (members,), what enters through all of them together.
        time: s, at which given fluxes are asked for; None: the present.

    Raises:
        ValueError: fluxes are given as exact, do not sum to ``total``, and no open valve takes what they leave.
    """
    active = openings.active(clock)
    found: dict[int, Tensor] = {}
    rest = total
    for number, plane in active:
        valve = openings.valve(number)
        if number in openings.given or valve.flux is None:
            continue
        region = sum(p.area for n, p in active if openings.all[n].label == openings.all[number].label)
        times = clock.of_members(len(total)).tolist() if time is None else [time] * len(total)
        given = [valve.flux_at(t) for t in times]
        found[number] = total.new_tensor(given) / openings.flux_unit * (plane.area / region) * clock.valve_strength
        rest = rest - found[number]
    free = takers(openings, active)
    if found and not free:
        return _reconciled(openings, found, rest, clock)
    if len(free) == 1:
        return found | {free[0][0]: rest}
    if free:
        numbers = tuple(n for n, _ in free)
        areas = total.new_tensor([plane.area * openings.valve(n).open_part(clock.middle) for n, plane in free])
        split = clock.flux_split
        if split is not None and set(numbers) <= set(split.numbers):
            shared = split.at(numbers, areas, rest)
        else:
            shared = rest[:, None] * (areas / areas.sum())
        found |= dict(zip(numbers, shared.unbind(1), strict=True))
    return found


def _reconciled(openings: Openings, found: dict[int, Tensor], rest: Tensor, clock: Clock) -> dict[int, Tensor]:
    """Given fluxes (members,) with what is missing, ``rest`` (members,), shared out by their variances."""
    variance = {number: openings.valve(number).flux_sigma ** 2 for number in found}
    whole = sum(variance.values())
    if whole > 0:
        return {number: flux + rest * (variance[number] / whole) for number, flux in found.items()}
    size = torch.stack([flux.abs() for flux in found.values()]).amax(0)
    if bool((rest.abs() > _UNANSWERED * size).any()):
        regions = ", ".join(str(openings.valve(number).region) for number in found)
        missing = float(rest.abs().max()) * openings.flux_unit
        raise ValueError(
            f"at {clock.middle:.4g} s the fluxes given for region {regions} miss the change of the cavity's volume by "
            f"{missing:.3g} m^3/s, and no open valve takes what they leave: open one without a flux, or say by "
            "flux_sigma that they are uncertain"
        )
    return found
