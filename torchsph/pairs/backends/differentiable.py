"""Derivatives of any backend's pair sums: values from the fast backend, adjoints from the plain one on the same pairs.

A pass is one node of torch's graph and keeps nothing but the arrays of the particles: what belongs to pairs is made
again where the adjoint is taken. The pressure equation is differentiated as what it is, an equation, and not as the
iterations that solved it: one more solve with the same operator, which is symmetric under the particles' masses (the
implicit function theorem; Blondel et al. 2022, sec. 2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from ..interface import Backend, Moments, MomentumTerms, PairState, Rates, RateTerms, Support
from ..poisson import PoissonSolution
from .reference import PairList, ReferenceBackend

_PLAIN = ReferenceBackend()
# the adjoint of a solve is not iterated on in the next step: it has to be right at once
_ADJOINT_TOLERANCE = 1e-6
_ADJOINT_ITERATIONS = 1000

Arrays = tuple[Tensor, ...]
Evaluate = Callable[[Sequence[Tensor]], Arrays]


@dataclass
class BothPairs:
    """The fast backend's pairs, and the plain list of the same search, which is made where an adjoint first asks."""

    fast: Any
    _make: Callable[[], PairList]
    _plain: PairList | None = field(default=None, repr=False)

    @property
    def plain(self) -> PairList:
        """The plain list."""
        if self._plain is None:
            self._plain = self._make()
        return self._plain


class DifferentiableBackend(Backend[BothPairs]):
    """Any backend's sums with derivatives of first order in all their arrays and coefficients.

    Where nothing asks for a gradient it is the fast backend, bit for bit.

    Args:
        fast: gives the values.
    """

    differentiable = True

    def __init__(self, fast: Backend) -> None:
        self._fast, self.name = fast, fast.name

    @property
    def overflows(self) -> int:  # type: ignore[override]
        """Searches of the fast backend that were made again."""
        return self._fast.overflows

    def search(
        self,
        position: Tensor,
        member: Tensor,
        radius: float,
        *,
        margin: float = 0.0,
        period: Tensor | None = None,
    ) -> BothPairs:
        """See ``Backend.search``."""
        place = position.detach()
        fast = self._fast.search(place, member, radius, margin=margin, period=period)
        return BothPairs(fast, lambda: _PLAIN.search(place, member, radius, margin=margin, period=period))

    def order(self, pairs: BothPairs) -> Tensor | None:
        """See ``Backend.order``."""
        return self._fast.order(pairs.fast)

    def rates(self, pairs: BothPairs, state: PairState, support: Support, terms: RateTerms) -> Rates:
        """See ``Backend.rates``."""
        names = [f.name for f in fields(Rates)]

        def some(backend: Backend, listed: Any, at: _Inputs) -> tuple[Tensor | None, ...]:
            found = backend.rates(listed, at.state, at.support, terms)
            return tuple(getattr(found, name) for name in names)

        given = _Inputs(state, support)
        return Rates(**dict(zip(names, self._taken(some, pairs, given), strict=True)))

    def momentum(self, pairs: BothPairs, state: PairState, support: Support, terms: MomentumTerms) -> Tensor:
        """See ``Backend.momentum``."""

        def some(backend: Backend, listed: Any, at: _Inputs) -> tuple[Tensor | None, ...]:
            return (backend.momentum(listed, at.state, at.support, at.momentum or terms),)

        return _present(self._taken(some, pairs, _Inputs(state, support, momentum=terms))[0])

    def right_hand_side(
        self, pairs: BothPairs, state: PairState, support: Support, rates: RateTerms, momentum: MomentumTerms
    ) -> tuple[Rates, Tensor]:
        """See ``Backend.right_hand_side``."""
        names = [f.name for f in fields(Rates)]

        def some(backend: Backend, listed: Any, at: _Inputs) -> tuple[Tensor | None, ...]:
            found, push = backend.right_hand_side(listed, at.state, at.support, rates, at.momentum or momentum)
            return (*(getattr(found, name) for name in names), push)

        *sums, push = self._taken(some, pairs, _Inputs(state, support, momentum=momentum))
        return Rates(**dict(zip(names, sums, strict=True))), _present(push)

    def laplacian(
        self, pairs: BothPairs, state: PairState, support: Support, field: Tensor, active: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """See ``Backend.laplacian``."""

        def some(backend: Backend, listed: Any, at: _Inputs) -> tuple[Tensor | None, ...]:
            return backend.laplacian(listed, at.state, at.support, _present(at.field), active)

        total, diagonal = self._taken(some, pairs, _Inputs(state, support, field=field))
        return _present(total), _present(diagonal)

    def poisson(
        self,
        pairs: BothPairs,
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
        """See ``Backend.poisson``; the solution is differentiated in the source, the positions and the masses."""
        group = state.member if group is None else group
        still = _Inputs(state, support).detached()

        def solved(right: Tensor, first: Tensor | None, fine: float, most: int) -> PoissonSolution:
            return self._fast.poisson(
                pairs.fast,
                still.state,
                still.support,
                right,
                first,
                free=free,
                active=active,
                singular=singular,
                tolerance=fine,
                iterations=most,
                group=group,
            )

        found = solved(source.detach(), None if start is None else start.detach(), tolerance, iterations)
        wanted = (source, state.position, state.mass, state.deviation)
        if not _derived(wanted):
            return found
        # what the solver answers: the source without its mean where the constant is in the null space
        mass = torch.where(free, state.mass, torch.zeros_like(state.mass))
        groups = singular.shape[0]
        sums = [mass.new_zeros(groups).index_add(0, group, part) for part in (mass * source, mass)]
        mean = torch.where(singular, sums[0] / sums[1].clamp_min(torch.finfo(mass.dtype).tiny), 0.0)
        answered = torch.where(free, source - mean.index_select(0, group), torch.zeros_like(source))
        image = self.laplacian(pairs, state, support, found.values, active)[0]
        left = torch.where(free, answered - image, torch.zeros_like(image))

        def adjoint(given: Tensor) -> Tensor:
            weight = still.state.mass
            right = torch.where(free, given / weight, torch.zeros_like(given))
            return weight * solved(right, None, _ADJOINT_TOLERANCE, _ADJOINT_ITERATIONS).values

        return replace(found, values=found.values + _Inverse.apply(left, adjoint))

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
        given = [position, fields, query, *([] if weight is None else [weight])]

        def some(backend: Backend, arrays: Sequence[Tensor]) -> Arrays:
            place, carried, wanted = arrays[:3]
            trust = arrays[3] if len(arrays) > 3 else None
            found = backend.interpolate(
                place, member, carried, support, wanted, query_member, period=period, weight=trust
            )
            return tuple(getattr(found, f.name) for f in _MOMENTS)

        if not _derived(given):
            return Moments(*some(self._fast, given))
        return Moments(
            *TakenTwice.apply(lambda arrays: some(self._fast, arrays), lambda arrays: some(_PLAIN, arrays), *given)
        )

    def _taken(
        self, some: Callable[[Backend, Any, _Inputs], tuple[Tensor | None, ...]], pairs: BothPairs, given: _Inputs
    ) -> tuple[Tensor | None, ...]:
        """Sums by the fast backend, as one node of the graph where a gradient is asked for."""
        arrays = given.arrays()
        if not _derived(arrays):
            return some(self._fast, pairs.fast, given.detached())
        present: list[bool] = []

        def by_fast(some_arrays: Sequence[Tensor]) -> Arrays:
            found = some(self._fast, pairs.fast, given.with_arrays(some_arrays))
            present.extend(value is not None for value in found)
            return tuple(value for value in found if value is not None)

        def by_plain(some_arrays: Sequence[Tensor]) -> Arrays:
            found = some(_PLAIN, pairs.plain, given.with_arrays(some_arrays))
            return tuple(value for value in found if value is not None)

        values = iter(TakenTwice.apply(by_fast, by_plain, *arrays))
        return tuple(next(values) if there else None for there in present)


_MOMENTS = fields(Moments)


@dataclass(frozen=True)
class _Inputs:
    """Everything that a pass over pairs reads and that it can be differentiated in."""

    state: PairState
    support: Support
    momentum: MomentumTerms | None = None
    field: Tensor | None = None

    _OF_STATE = ("position", "velocity", "mass", "deviation", "pressure", "slope")

    def arrays(self) -> list[Tensor]:
        """The tensors of real numbers, those of ``with_arrays``."""
        return [value for _, _, value in self._places()]

    def _places(self) -> list[tuple[str, str, Tensor]]:
        found = [("state", name, getattr(self.state, name)) for name in self._OF_STATE]
        found.append(("support", "length", self.support.length))
        if self.momentum is not None:
            found.extend(("momentum", name, getattr(self.momentum, name)) for name in ("artificial", "laminar"))
        found.append(("", "field", self.field))
        return [(owner, name, value) for owner, name, value in found if isinstance(value, Tensor)]

    def with_arrays(self, arrays: Sequence[Tensor]) -> _Inputs:
        """The same with other tensors in the order of ``arrays``."""
        changed: dict[str, dict[str, Tensor]] = {"state": {}, "support": {}, "momentum": {}, "": {}}
        for (owner, name, _), value in zip(self._places(), arrays, strict=True):
            changed[owner][name] = value
        return _Inputs(
            replace(self.state, **changed["state"]),
            replace(self.support, **changed["support"]),  # type: ignore[arg-type]
            None if self.momentum is None else replace(self.momentum, **changed["momentum"]),  # type: ignore[arg-type]
            changed[""].get("field"),
        )

    def detached(self) -> _Inputs:
        """The same without gradients."""
        return self.with_arrays([value.detach() for value in self.arrays()])


class TakenTwice(torch.autograd.Function):
    """Values by one function of arrays, first derivatives by another that torch differentiates when they are needed.

    Nothing but the arrays is kept from one to the other.
    """

    @staticmethod
    def forward(ctx: Any, fast: Evaluate, plain: Evaluate, *arrays: Tensor) -> Arrays:
        """See ``torch.autograd.Function``."""
        ctx.plain = plain
        ctx.save_for_backward(*arrays)
        return fast([array.detach() for array in arrays])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *given: Tensor | None) -> tuple[Tensor | None, ...]:
        """See ``torch.autograd.Function``."""
        wanted = ctx.needs_input_grad[2:]
        with torch.enable_grad():
            arrays = [
                array.detach().requires_grad_(need) for array, need in zip(ctx.saved_tensors, wanted, strict=True)
            ]
            values = ctx.plain(arrays)
            some = [(value, g) for value, g in zip(values, given, strict=True) if g is not None and value.requires_grad]
            leaves = [array for array, need in zip(arrays, wanted, strict=True) if need]
            if not some:
                return (None,) * (2 + len(arrays))
            found = torch.autograd.grad([v for v, _ in some], leaves, [g for _, g in some], allow_unused=True)
        answers = iter(found)
        return (None, None, *(next(answers) if need else None for need in wanted))


class _Inverse(torch.autograd.Function):
    """The inverse of a linear operator on a residual that is nought: nought forwards, an adjoint solve backwards."""

    @staticmethod
    def forward(ctx: Any, residual: Tensor, adjoint: Callable[[Tensor], Tensor]) -> Tensor:
        """See ``torch.autograd.Function``."""
        ctx.adjoint = adjoint
        return torch.zeros_like(residual)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor, None]:
        """See ``torch.autograd.Function``."""
        return ctx.adjoint(given), None


def _derived(arrays: Sequence[Tensor]) -> bool:
    """Whether torch is to differentiate something in these arrays."""
    return torch.is_grad_enabled() and any(array.requires_grad for array in arrays)


def _present(value: Tensor | None) -> Tensor:
    if value is None:
        raise ValueError("a pair pass gave no value for what it was asked for")
    return value
