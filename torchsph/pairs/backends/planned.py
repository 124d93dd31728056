"""What the compiled backends share: requests become passes, passes fill sums; nothing here knows a device."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from ..interface import Backend, MomentumTerms, PairState, Rates, RateTerms, Support
from . import plan
from .checks import check_shapes, expect


class Counted(Protocol):
    """Pairs that know of how many particles they are, and in how many dimensions."""

    @property
    def count(self) -> int:
        """Number of particles of the search."""
        ...

    @property
    def period(self) -> list[float]:
        """Of each axis, inf where it is not periodic."""
        ...


Planned = TypeVar("Planned", bound=Counted)


class PlannedBackend(Backend[Planned]):
    """A backend that evaluates one ``plan.Pass`` at a time; not differentiable."""

    device: str

    @abstractmethod
    def _evaluate(
        self,
        pairs: Planned,
        state: PairState,
        support: Support,
        request: plan.Pass,
        field: Tensor | None = None,
        active: Tensor | None = None,
    ) -> list[Tensor]:
        """The sums of one pass, in the order of ``request.outputs``.

        Args:
            pairs: of ``search``.
            state: the particles.
            support: kernel and smoothing length.
            request: terms, weight and coefficients.
            field: (N,), of which the Laplacian is taken.
            active: (N,) bool, the particles that take part in it; None: all.
        """

    def _shares_loops(self, dtype: torch.dtype) -> bool:
        """Whether the combinations of ``plan.shared_passes`` are compiled for this precision."""
        return True

    def rates(self, pairs: Planned, state: PairState, support: Support, terms: RateTerms) -> Rates:
        """See ``Backend.rates``."""
        return Rates(**self._sums(pairs, state, support, plan.rate_passes(terms)))

    def momentum(self, pairs: Planned, state: PairState, support: Support, terms: MomentumTerms) -> Tensor:
        """See ``Backend.momentum``."""
        request = plan.force_pass(terms)
        if request is None:
            return torch.zeros_like(state.position)
        return self._sums(pairs, state, support, [request])["acceleration"]

    def right_hand_side(
        self, pairs: Planned, state: PairState, support: Support, rates: RateTerms, momentum: MomentumTerms
    ) -> tuple[Rates, Tensor]:
        """See ``Backend.right_hand_side``."""
        shared = plan.shared_passes(rates, momentum) if self._shares_loops(state.position.dtype) else None
        if shared is None:
            return super().right_hand_side(pairs, state, support, rates, momentum)
        sums = self._sums(pairs, state, support, shared)
        acceleration = sums.pop("acceleration")
        return Rates(**sums), acceleration

    def laplacian(
        self, pairs: Planned, state: PairState, support: Support, field: Tensor, active: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """See ``Backend.laplacian``."""
        self._check_state(pairs, state)
        self._check_field(state, field, active)
        request = plan.Pass(plan.LAPLACIAN, plan.BY_VOLUME)
        total, diagonal = self._evaluate(pairs, state, support, request, field, active)
        return total, diagonal

    def _sums(
        self, pairs: Planned, state: PairState, support: Support, requests: Sequence[plan.Pass]
    ) -> dict[str, Tensor]:
        self._check_state(pairs, state)
        sums: dict[str, Tensor] = {}
        for request in requests:
            if request.terms & plan.STRESSED:
                self.check(state.position, state.pressure)
                expect("the state's pressure", state.pressure, (pairs.count,))
            if request.terms & plan.SLOPED:
                self.check(state.position, slope_of(state))
                expect("the state's slope", slope_of(state), tuple(state.position.shape))
            outputs = self._evaluate(pairs, state, support, request)
            sums.update(zip(request.outputs, outputs, strict=True))
        return sums

    def _check_state(self, pairs: Planned, state: PairState) -> None:
        self.check(state.position, state.velocity, state.mass, state.deviation)
        if state.position.shape[0] != pairs.count:
            raise ValueError(
                f"the pairs are of {pairs.count} particles and the state of {state.position.shape[0]}: search anew"
            )
        check_shapes(state, len(pairs.period))

    def _check_field(self, state: PairState, field: Tensor, active: Tensor | None) -> None:
        count = state.position.shape[0]
        self.check(state.position, field)
        expect("the field", field, (count,))
        if active is not None:
            expect("active", active, (count,), torch.bool)

    def check(self, *tensors: Tensor) -> None:
        """ValueError or TypeError unless all tensors are of one real type, here, without gradient."""
        kind = tensors[0].dtype
        for tensor in tensors:
            if tensor.device.type != self.device:
                raise ValueError(
                    f"the {self.name} backend works on {self.device} tensors, got one on '{tensor.device}'; "
                    "use backend='auto'"
                )
            if tensor.dtype != kind or kind not in (torch.float32, torch.float64):
                raise TypeError(
                    f"the {self.name} backend wants all arrays in float32 or all in float64, got {kind}, {tensor.dtype}"
                )
            if tensor.requires_grad:
                raise ValueError(
                    f"the {self.name} backend is not differentiable; make the Simulator with differentiable=True, "
                    "or use backend='reference' for gradients of the sums alone"
                )


def slope_of(state: PairState) -> Tensor:
    """The state's slope (N, D); ValueError where it has none."""
    if state.slope is None:
        raise ValueError("corrected_diffusion needs the state's slope (PairState.slope)")
    return state.slope


def lengths(period: Tensor | None, dimension: int) -> list[float]:
    """Period of each axis as floats, inf where it is not periodic."""
    return [float("inf")] * dimension if period is None else [float(length) for length in period]
