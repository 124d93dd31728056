"""The C++ backend: cluster lists of 8 particles, one compiled loop per combination of terms."""

from __future__ import annotations

import weakref
from collections import deque
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsph.native.library import LibraryMissing, library

from ..interface import Moments, PairState, Support, check_search
from ..poisson import PoissonSolution
from . import cpu_operators as operators
from . import plan
from .checks import check_groups, check_particles, check_period, expect
from .planned import PlannedBackend, lengths, slope_of

# buffers of lists that nobody holds any more; a few, so that memory is given back
_SPARE: deque[Tensor] = deque(maxlen=4)


@dataclass(frozen=True)
class ClusterPairs:
    """Clusters of 8 particles and, for each, the particles within reach of any of its 8.

    Attributes:
        lists: slot, owner, entries, offset, home of ``cpu_operators.cluster_lists``.
        period: (D,) floats, inf where an axis is not periodic.
        count: number of particles of the search.
        used: how much of the entries the lists fill.
    """

    lists: list[Tensor]
    period: list[float]
    count: int
    used: int

    @property
    def order(self) -> Tensor:
        """Particle indices (N,) in the order of the clusters; arrays kept in this order are packed faster."""
        slot = self.lists[0]
        return slot[slot >= 0].to(torch.int64)

    @property
    def members(self) -> int:
        """Number of members, but for those after the last that has particles."""
        owner = self.lists[1]
        return int(owner[-1]) + 1 if owner.numel() else 1  # clusters stand in order of their members

    @property
    def bytes(self) -> int:
        """Memory of the lists."""
        entries = self.lists[2]
        spare = (entries.numel() - self.used) * entries.element_size()
        return sum(tensor.numel() * tensor.element_size() for tensor in self.lists) - spare


class CpuBackend(PlannedBackend[ClusterPairs]):
    """Compiled pair sums, float32 or float64, on as many threads as torch uses; not differentiable.

    A particle's result does not depend on the number of threads, nor on which other members are in the batch.
    """

    name, device = "cpu", "cpu"

    def __init__(self) -> None:
        self.instruction_set = library().instruction_set
        self.entries_per_particle = 40.0  # of the last search; the first guess

    def search(
        self,
        position: Tensor,
        member: Tensor,
        radius: float,
        *,
        margin: float = 0.0,
        period: Tensor | None = None,
    ) -> ClusterPairs:
        """See ``Backend.search``."""
        self.check(position)
        check_particles(position, member)
        check_period(period, position.shape[1])
        length = lengths(period, position.shape[1])
        check_search(None, radius + margin, period)
        entries = self._room(int(1.1 * self.entries_per_particle * position.shape[0]) + 64)
        while True:
            slot, owner, offset, home, needed = operators.cluster_lists(
                position.detach().contiguous(), member.contiguous(), radius + margin, length, entries
            )
            used = int(needed)
            if used <= entries.numel():
                break
            self.overflows += 1
            entries = self._room(int(1.1 * used))
        self.entries_per_particle = used / max(position.shape[0], 1)
        pairs = ClusterPairs([slot, owner, entries, offset, home], length, position.shape[0], used)
        weakref.finalize(pairs, _SPARE.append, entries).atexit = False
        return pairs

    def order(self, pairs: ClusterPairs) -> Tensor:
        """See ``Backend.order``."""
        return pairs.order

    @staticmethod
    def _room(entries: int) -> Tensor:
        """An int32 buffer that no pairs use any more, or a new one: fresh pages cost as much as a search."""
        while _SPARE:
            spare = _SPARE.pop()
            if entries <= spare.numel() <= 4 * entries:
                return spare
        return torch.empty(entries, dtype=torch.int32)

    def _shares_loops(self, dtype: torch.dtype) -> bool:
        return dtype == torch.float32 and self.instruction_set != "baseline"

    def _evaluate(
        self,
        pairs: ClusterPairs,
        state: PairState,
        support: Support,
        request: plan.Pass,
        field: Tensor | None = None,
        active: Tensor | None = None,
    ) -> list[Tensor]:
        kind, numbers = plan.kernel_choice(support, self.name)
        return operators.pair_pass(
            pairs.lists,
            pairs.period,
            [request.terms, request.weight, request.form, kind],
            numbers,
            plan.coefficients(support, request.momentum, pairs.members),
            *(t.contiguous() for t in (state.position, state.velocity, state.mass, state.deviation)),
            state.pressure.contiguous() if request.terms & plan.STRESSED else None,
            slope_of(state).contiguous() if request.terms & plan.SLOPED else None,
            None if field is None else field.contiguous(),
            None if active is None else active.contiguous(),
        )

    def poisson(
        self,
        pairs: ClusterPairs,
        state: PairState,
        support: Support,
        source: Tensor,
        start: Tensor | None,
        *,
        free: Tensor,
        active: Tensor,
        singular: Tensor,
        tolerance: float,
        iterations: int,
        group: Tensor | None = None,
    ) -> PoissonSolution:
        """See ``Backend.poisson``."""
        self.check(state.position, source, *(() if start is None else (start,)))
        self._check_state(pairs, state)
        self._check_field(state, source, active)
        if start is not None:
            expect("start", start, (pairs.count,))
        expect("free", free, (pairs.count,), torch.bool)
        expect("singular", singular, (-1,), torch.bool)
        check_groups(state.member if group is None else group, singular.shape[0], pairs.count)
        kind, numbers = plan.kernel_choice(support, self.name)
        group = state.member if group is None else group
        values, count, residual, converged, mismatch = operators.poisson(
            pairs.lists,
            pairs.period,
            kind,
            numbers,
            plan.coefficients(support, None, pairs.members),
            state.position.contiguous(),
            state.mass.contiguous(),
            state.deviation.contiguous(),
            group.contiguous(),
            source.contiguous(),
            None if start is None else start.contiguous(),
            free.contiguous(),
            active.contiguous(),
            singular.contiguous(),
            tolerance,
            iterations,
        )
        return PoissonSolution(values, count, residual, converged, mismatch)

    def interpolate(
        self,
        position: Tensor,
        member: Tensor,
        fields: Tensor,
        support: Support,
        query: Tensor,
        query_member: Tensor,
        *,
        period: Tensor | None = None,
        weight: Tensor | None = None,
    ) -> Moments:
        """See ``Backend.interpolate``."""
        self.check(position, fields, query, *(() if weight is None else (weight,)))
        check_particles(position, member)
        check_particles(query, query_member, ("query", "query_member"))
        check_period(period, position.shape[1])
        expect("query", query, (-1, position.shape[1]))
        expect("fields", fields, (position.shape[0], -1))
        if weight is not None:
            expect("weight", weight, (position.shape[0],))
        check_search(None, support.radius, period)
        members = 1 + max((int(m.max()) for m in (member, query_member) if m.numel()), default=0)
        kind, numbers = plan.kernel_choice(support, self.name)
        smoothing = torch.as_tensor(support.length, dtype=torch.float64).expand(members).contiguous()
        tensors = (t.detach().contiguous() for t in (position, member, fields, query, query_member))
        return Moments(
            *operators.interpolation_moments(
                *tensors,
                support.radius,
                lengths(period, position.shape[1]),
                kind,
                numbers,
                smoothing,
                None if weight is None else weight.contiguous(),
            )
        )


def status(device: str) -> tuple[bool, str]:
    """Whether the backend can be used on ``device``, and why (not)."""
    if torch.device(device).type != "cpu":
        return False, f"works on CPU tensors only, the device asked for is '{device}'"
    try:
        compiled = library()
    except LibraryMissing as problem:
        return False, str(problem)
    return True, f"compiled C++ on {compiled.instruction_set} instructions"
