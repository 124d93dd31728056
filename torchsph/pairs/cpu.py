"""The C++ backend: cluster lists of 8 particles, one compiled loop per combination of terms."""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..smoothing import KERNELS, SmoothingKernel
from . import cpu_operators as operators
from .interface import (
    PRESSURE_FORMS,
    Backend,
    Moments,
    MomentumTerms,
    PairState,
    Rates,
    RateTerms,
    Support,
    check_search,
)
from .native import library

# the order of sph::Kernel in csrc/smoothing.hpp
_KERNELS = ("wendland_c2", "wendland_c4", "wendland_c6", "cubic", "quintic", "gaussian", "spiky")
_BY_VOLUME, _BY_MASS = 0, 1
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
    def bytes(self) -> int:
        """Memory of the lists."""
        entries = self.lists[2]
        spare = (entries.numel() - self.used) * entries.element_size()
        return sum(tensor.numel() * tensor.element_size() for tensor in self.lists) - spare


class CpuBackend(Backend):
    """Compiled pair sums, float32 or float64, on as many threads as torch uses; not differentiable.

    A particle's result does not depend on the number of threads, nor on which other members are in the batch.
    """

    name = "cpu"

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
        _check_reals(position)
        length = _lengths(period, position.shape[1])
        check_search(None, radius + margin, period)
        entries = self._room(int(1.1 * self.entries_per_particle * position.shape[0]) + 64)
        while True:
            slot, owner, offset, home, needed = operators.cluster_lists(
                position.detach().contiguous(), member.contiguous(), radius + margin, length, entries
            )
            used = int(needed)
            if used <= entries.numel():
                break
            entries = self._room(int(1.1 * used))
        self.entries_per_particle = used / max(position.shape[0], 1)
        pairs = ClusterPairs([slot, owner, entries, offset, home], length, position.shape[0], used)
        weakref.finalize(pairs, _SPARE.append, entries).atexit = False
        return pairs

    @staticmethod
    def _room(entries: int) -> Tensor:
        """An int32 buffer that no pairs use any more, or a new one: fresh pages cost as much as a search."""
        while _SPARE:
            spare = _SPARE.pop()
            if entries <= spare.numel() <= 4 * entries:
                return spare
        return torch.empty(entries, dtype=torch.int32)

    def rates(self, pairs: ClusterPairs, state: PairState, support: Support, terms: RateTerms) -> Rates:
        run = _Passes(pairs, state, support)
        run.rates(terms)
        return run.result()

    def momentum(
        self, pairs: ClusterPairs, state: PairState, support: Support, terms: MomentumTerms
    ) -> Tensor:
        run = _Passes(pairs, state, support)
        run.momentum(terms)
        return run.sums["acceleration"]

    def right_hand_side(
        self,
        pairs: ClusterPairs,
        state: PairState,
        support: Support,
        rates: RateTerms,
        momentum: MomentumTerms,
    ) -> tuple[Rates, Tensor]:
        run = _Passes(pairs, state, support)
        run.together(rates, momentum)
        return run.result(), run.sums["acceleration"]

    def laplacian(
        self,
        pairs: ClusterPairs,
        state: PairState,
        support: Support,
        field: Tensor,
        active: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        run = _Passes(pairs, state, support)
        run.one(operators.LAPLACIAN, _BY_VOLUME, field=field, active=active)
        return run.sums["laplacian"], run.sums["diagonal"]

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
    ) -> Moments:
        _check_reals(position, fields, query)
        check_search(None, support.radius, period)
        members = 1 + max((int(m.max()) for m in (member, query_member) if m.numel()), default=0)
        kind, numbers = _kernel_choice(support)
        lengths = torch.as_tensor(support.length, dtype=torch.float64).expand(members).contiguous()
        tensors = (t.detach().contiguous() for t in (position, member, fields, query, query_member))
        return Moments(
            *operators.interpolation_moments(
                *tensors, support.radius, _lengths(period, position.shape[1]), kind, numbers, lengths
            )
        )


class _Passes:
    """The passes of one call and the sums that they have filled so far."""

    def __init__(self, pairs: ClusterPairs, state: PairState, support: Support) -> None:
        _check_reals(state.position, state.velocity, state.mass, state.deviation)
        if state.position.shape[0] != pairs.count:
            raise ValueError(
                f"the pairs are of {pairs.count} particles and the state of {state.position.shape[0]}: "
                "search anew"
            )
        self.pairs, self.state, self.support = pairs, state, support
        self.arrays = [t.contiguous() for t in (state.position, state.velocity, state.mass, state.deviation)]
        self.sums: dict[str, Tensor] = {}

    def result(self) -> Rates:
        return Rates(**{name: total for name, total in self.sums.items() if name != "acceleration"})

    def rates(self, terms: RateTerms) -> None:
        by_volume = (
            operators.DIFFUSION * terms.diffusion
            | operators.CONCENTRATION * terms.concentration
            | operators.XSPH * terms.xsph
            | operators.CONTINUITY * (terms.continuity == "volume")
        )
        if terms.continuity == "mass":
            apart = terms.diffusion or terms.concentration  # these are weighted by volume
            self.one(operators.CONTINUITY | (0 if apart else by_volume), _BY_MASS)
            by_volume = by_volume if apart else 0
        if by_volume:
            self.one(by_volume, _BY_VOLUME)
        self._others(terms)

    def momentum(self, terms: MomentumTerms) -> None:
        flags, weight = _forces(terms)
        if flags:
            self.one(flags, weight, terms)
        else:
            self.sums["acceleration"] = torch.zeros_like(self.state.position)

    def together(self, rates: RateTerms, momentum: MomentumTerms) -> None:
        """Rates and forces in one loop where that is compiled, else one after the other."""
        flags, weight = _forces(momentum)
        same_weight = rates.continuity == ("volume" if weight == _BY_VOLUME else "mass")
        fits = flags & operators.PRESSURE and not flags & operators.TENSILE and same_weight
        fits = fits and not rates.concentration and not (rates.diffusion and weight == _BY_MASS)
        if not fits or not _fuses(self.state.position):
            self.rates(rates)
            self.momentum(momentum)
            return
        flags |= operators.CONTINUITY | operators.DIFFUSION * rates.diffusion | operators.XSPH * rates.xsph
        self.one(flags, weight, momentum)
        self._others(rates)

    def _others(self, terms: RateTerms) -> None:
        if terms.shepard:
            self.one(operators.SHEPARD, _BY_VOLUME)
        if terms.renormalisation:
            self.one(operators.RENORMALISATION, _BY_VOLUME)

    def one(
        self,
        terms: int,
        weight: int,
        momentum: MomentumTerms | None = None,
        field: Tensor | None = None,
        active: Tensor | None = None,
    ) -> None:
        kind, numbers = _kernel_choice(self.support)
        form = (
            PRESSURE_FORMS.index(momentum.pressure)
            if momentum is not None and momentum.pressure is not None
            else 0
        )
        pressure = self.state.pressure.contiguous() if terms & operators.PRESSURE else None
        if pressure is not None or field is not None:
            _check_reals(self.state.position, *(t for t in (pressure, field) if t is not None))
        outputs = operators.pair_pass(
            self.pairs.lists,
            self.pairs.period,
            [terms, weight, form, kind],
            numbers,
            self._coefficients(momentum),
            *self.arrays,
            pressure,
            None if field is None else field.contiguous(),
            None if active is None else active.contiguous(),
        )
        self.sums.update(zip(operators.output_names(terms), outputs, strict=True))

    def _coefficients(self, momentum: MomentumTerms | None) -> Tensor:
        """(members, 4) float64: smoothing length, artificial and laminar viscosity, tensile coefficient."""
        length = self.support.length
        artificial, laminar, tensile = 0.0, 0.0, 0.0
        if momentum is not None:
            artificial = 0.0 if momentum.artificial is None else momentum.artificial
            laminar = 0.0 if momentum.laminar is None else momentum.laminar
            if momentum.tensile is not None:
                tensile = momentum.tensile / _shape_at(self.support, momentum.tensile_distance) ** 4
        columns = (length, artificial, laminar, tensile)
        owner = self.pairs.lists[1]
        members = int(owner[-1]) + 1 if owner.numel() else 1  # clusters stand in order of their members
        table = torch.empty((members, 4), dtype=torch.float64)
        for index, value in enumerate(columns):
            table[:, index] = value if not isinstance(value, Tensor) or value.ndim == 0 else value[:members]
        return table


def _forces(terms: MomentumTerms) -> tuple[int, int]:
    flags = (
        operators.PRESSURE * (terms.pressure is not None)
        | operators.ARTIFICIAL * (terms.artificial is not None)
        | operators.LAMINAR * (terms.laminar is not None)
        | operators.TENSILE * (terms.tensile is not None)
    )
    return flags, _BY_MASS if terms.pressure in (None, "symmetric") else _BY_VOLUME


def _fuses(position: Tensor) -> bool:
    return position.dtype == torch.float32 and library().instruction_set != "baseline"


def _kernel_choice(support: Support) -> tuple[int, Sequence[float]]:
    kernel: SmoothingKernel = support.kernel
    family = "gaussian" if kernel.name.startswith("gaussian") else kernel.name
    known = family == "gaussian" or KERNELS.get(kernel.name) is kernel
    if family not in _KERNELS or not known:
        raise ValueError(
            f"the cpu backend has no kernel '{kernel.name}' compiled in; use backend='reference', or one of "
            f"{', '.join(_KERNELS)}"
        )
    return _KERNELS.index(family), (kernel.support, kernel.normalisation[support.dimension])


def _shape_at(support: Support, distance: float) -> float | Tensor:
    ratio = torch.as_tensor(distance, dtype=torch.float64) / torch.as_tensor(
        support.length, dtype=torch.float64
    )
    if bool((ratio >= support.kernel.support).any()):
        raise ValueError(
            f"tensile_distance {distance:g} lies outside the kernel's support; give the particle spacing"
        )
    return support.kernel.shape(ratio)


def _lengths(period: Tensor | None, dimension: int) -> list[float]:
    return [float("inf")] * dimension if period is None else [float(length) for length in period]


def _check_reals(*tensors: Tensor) -> None:
    kind = tensors[0].dtype
    for tensor in tensors:
        if tensor.device.type != "cpu":
            raise ValueError(
                f"the cpu backend works on CPU tensors, got one on '{tensor.device}'; use backend='auto'"
            )
        if tensor.dtype != kind or kind not in (torch.float32, torch.float64):
            raise TypeError(
                f"the cpu backend wants all arrays in float32 or all in float64, got {kind}, {tensor.dtype}"
            )
        if tensor.requires_grad:
            raise ValueError("the cpu backend is not differentiable; use backend='reference' for gradients")
