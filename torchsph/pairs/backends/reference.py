"""The pair sums in plain torch: differentiable, float32 or float64, any device; the oracle of the others."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..cell_search import cross_pairs, half_pairs, nearest_image
from ..interface import Backend, Moments, MomentumTerms, PairState, Rates, RateTerms, Support, check_search
from ..vectors import per_particle

# keeps 1 / r^2 finite for coinciding particles, in squared smoothing lengths (epsilon of Grønli 2017, eq. 2.28)
SINGULARITY = 0.01
TENSILE_POWER = 4


@dataclass(frozen=True)
class PairList:
    """Every unordered pair once: indices (P,) and the periods that bring b next to a (None: no period)."""

    first: Tensor
    second: Tensor
    period: Tensor | None

    def separation(self, position: Tensor) -> Tensor:
        """x_a - x_b of the nearest images, (P, D)."""
        gap = position.index_select(0, self.first) - position.index_select(0, self.second)
        return nearest_image(gap, self.period)


class ReferenceBackend(Backend[PairList]):
    """Eager torch on a list that holds each pair once; both of its sides are added from the same numbers."""

    name, differentiable = "reference", True

    def search(
        self,
        position: Tensor,
        member: Tensor,
        radius: float,
        *,
        margin: float = 0.0,
        period: Tensor | None = None,
    ) -> PairList:
        """See ``Backend.search``."""
        check_search(position, radius + margin, period)
        first, second = half_pairs(position.detach(), member, radius + margin, period)
        return PairList(first, second, period)

    def rates(self, pairs: PairList, state: PairState, support: Support, terms: RateTerms) -> Rates:
        """See ``Backend.rates``."""
        geometry = _Geometry(pairs, state, support)
        volume = state.volume
        va, vb = geometry.ends(volume)
        out: dict[str, Tensor] = {}
        if terms.continuity is not None or terms.xsph:
            jump = geometry.second_minus_first(state.velocity)
        if terms.continuity is not None:
            wa, wb = (va, vb) if terms.continuity == "volume" else geometry.ends(state.mass)
            flux = (jump * geometry.gradient).sum(1)
            out["divergence"] = geometry.collect(wb * flux, wa * flux)
        if terms.diffusion or terms.corrected_diffusion:
            rise = geometry.second_minus_first(state.deviation)
            if terms.corrected_diffusion:
                rise = rise + _linear_part(geometry, state)
            spread = -2.0 * geometry.factor * rise
            out["diffusion"] = geometry.collect(vb * spread, -va * spread)
        if terms.concentration:
            out["concentration"] = geometry.collect(vb[:, None] * geometry.gradient, -va[:, None] * geometry.gradient)
        if terms.xsph:
            ma, mb = geometry.ends(state.mass)
            da, db = geometry.ends(state.deviation)
            pull = (geometry.value / (1.0 + 0.5 * (da + db)))[:, None] * jump
            out["xsph"] = geometry.collect(mb[:, None] * pull, -ma[:, None] * pull)
        if terms.gradient:
            rise = geometry.second_minus_first(state.deviation)[:, None] * geometry.gradient
            out["gradient"] = geometry.collect(vb[:, None] * rise, va[:, None] * rise)
        if terms.renormalisation:
            outer = -geometry.gap[:, :, None] * geometry.gradient[:, None, :]
            out["renormalisation"] = geometry.collect(vb[:, None, None] * outer, va[:, None, None] * outer)
        if terms.shepard:
            out |= _shepard_sums(geometry, state)
        if terms.moments:
            out |= _moment_sums(geometry, state)
        return Rates(**out)

    def momentum(self, pairs: PairList, state: PairState, support: Support, terms: MomentumTerms) -> Tensor:
        """See ``Backend.momentum``."""
        geometry = _Geometry(pairs, state, support)
        ma, mb = geometry.ends(state.mass)
        da, db = geometry.ends(state.deviation)
        ra, rb = 1.0 + da, 1.0 + db
        shared = _central_forces(geometry, state, support, terms, ra, rb)
        push = shared[:, None] * geometry.gradient
        to_first, to_second = -mb[:, None] * push, ma[:, None] * push
        if terms.pressure in ("switched", "difference"):
            pa, pb = geometry.ends(state.pressure)
            own_a, own_b = (pa.abs(), pb.abs()) if terms.pressure == "switched" else (-pa, -pb)
            inverse = (1.0 / (ra * rb))[:, None] * geometry.gradient
            to_first = to_first - (mb * (pb + own_a))[:, None] * inverse
            to_second = to_second + (ma * (pa + own_b))[:, None] * inverse
        if terms.laminar is not None:
            nu = geometry.first_of(per_particle(terms.laminar, state.member))
            rate = nu * (ra + rb) / (ra * rb) * geometry.factor * geometry.square * geometry.inverse_square
            drag = rate[:, None] * -geometry.second_minus_first(state.velocity)
            to_first, to_second = to_first + mb[:, None] * drag, to_second - ma[:, None] * drag
        return geometry.collect(to_first, to_second)

    def laplacian(
        self, pairs: PairList, state: PairState, support: Support, field: Tensor, active: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """See ``Backend.laplacian``."""
        geometry = _Geometry(pairs, state, support)
        va, vb = geometry.ends(state.volume)
        weight = -2.0 * geometry.factor * geometry.square * geometry.inverse_square
        if active is not None:
            a, b = geometry.ends(active)
            weight = weight * (a & b).to(weight.dtype)
        drop = -geometry.second_minus_first(field) * weight
        return geometry.collect(vb * drop, -va * drop), geometry.collect(vb * weight, va * weight)

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
        check_search(torch.cat((position, query)), support.radius, period)
        row, particle = cross_pairs(query, query_member, position, member, support.radius, period)
        offset = nearest_image(position.index_select(0, particle) - query.index_select(0, row), period)
        length: float | Tensor
        if support.per_particle:
            length = torch.as_tensor(support.length).index_select(0, particle)
        else:
            length = per_particle(support.length, query_member.index_select(0, row))
        share = support.kernel.value(offset.norm(dim=1), length, support.dimension)
        share = share if weight is None else share * weight.index_select(0, particle)
        first = share[:, None] * offset
        carried = fields.index_select(0, particle)

        def collect(part: Tensor) -> Tensor:
            return part.new_zeros((query.shape[0], *part.shape[1:])).index_add(0, row, part)

        return Moments(
            collect((share > 0).to(share.dtype)),
            collect(share),
            collect(first),
            collect(first[:, :, None] * offset[:, None, :]),
            collect(share[:, None] * carried),
            collect(first[:, :, None] * carried[:, None, :]),
        )


def _central_forces(
    geometry: _Geometry, state: PairState, support: Support, terms: MomentumTerms, ra: Tensor, rb: Tensor
) -> Tensor:
    """The scalar S_ab = S_ba of the forces -m_a m_b S_ab grad_a W_ab, which conserve both momenta (P,)."""
    shared = torch.zeros_like(geometry.square)
    pa, pb = geometry.ends(state.pressure)
    if terms.pressure == "symmetric":
        stress_a, stress_b = pa / ra**2, pb / rb**2
        shared = shared + stress_a + stress_b
        if terms.tensile is not None:
            shared = shared + geometry.tensile_weight(terms.tensile_distance) * terms.tensile * (
                stress_a.abs() + stress_b.abs()
            )
    elif terms.pressure == "sum":
        shared = shared + (pa + pb) / (ra * rb)
    if terms.artificial is not None:
        approach = (-geometry.second_minus_first(state.velocity) * geometry.gap).sum(1).clamp_max(0.0)
        strength = geometry.first_of(per_particle(terms.artificial, state.member)) * geometry.length
        shared = shared - strength * approach * geometry.inverse_square / (0.5 * (ra + rb))
    return shared


def _linear_part(geometry: _Geometry, state: PairState) -> Tensor:
    """-(slope_a + slope_b) . (x_b - x_a) / 2, what the diffusion of Antuono et al. 2010 leaves alone (P,)."""
    if state.slope is None:
        raise ValueError("corrected_diffusion needs the state's slope: the renormalised gradient of the deviation")
    slope_a, slope_b = geometry.ends(state.slope)
    return 0.5 * ((slope_a + slope_b) * geometry.gap).sum(1)


def _shepard_sums(geometry: _Geometry, state: PairState) -> dict[str, Tensor]:
    centre = geometry.value_at_zero()
    (va, vb), (ma, mb) = geometry.ends(state.volume), geometry.ends(state.mass)
    volume = geometry.collect(vb * geometry.value, va * geometry.value)
    mass = geometry.collect(mb * geometry.value, ma * geometry.value)
    return {"shepard_volume": volume + state.volume * centre, "shepard_mass": mass + state.mass * centre}


def _moment_sums(geometry: _Geometry, state: PairState) -> dict[str, Tensor]:
    first = -geometry.value[:, None] * geometry.gap  # b - a; the other way round for b
    second = geometry.value[:, None, None] * geometry.gap[:, :, None] * geometry.gap[:, None, :]
    (va, vb), (ma, mb) = geometry.ends(state.volume), geometry.ends(state.mass)
    return {
        "moment_first": geometry.collect(vb[:, None] * first, -va[:, None] * first),
        "moment_second": geometry.collect(vb[:, None, None] * second, va[:, None, None] * second),
        "moment_mass": geometry.collect(mb[:, None] * first, -ma[:, None] * first),
    }


class _Geometry:
    """Distances and kernel values of the pairs, evaluated where a term first asks for them."""

    def __init__(self, pairs: PairList, state: PairState, support: Support) -> None:
        self.first, self.second = pairs.first, pairs.second
        self.count = state.position.shape[0]
        self.support = support
        self.gap = pairs.separation(state.position)
        self.square = (self.gap * self.gap).sum(1)
        # the square root has no derivative at zero; the shift is far below the rounding of any real distance
        self.distance = torch.sqrt(self.square + torch.finfo(self.square.dtype).tiny)
        self._length: float | Tensor
        self.length: float | Tensor
        if support.per_particle:
            self._length = torch.as_tensor(support.length)
            first, second = self.ends(self._length)
            self.length = 0.5 * (first + second)
        else:
            self._length = per_particle(support.length, state.member)
            self.length = self.first_of(self._length)
        self.factor = support.kernel.gradient_factor(self.distance, self.length, support.dimension)
        self.gradient = self.factor[:, None] * self.gap
        self._value: Tensor | None = None

    @property
    def value(self) -> Tensor:
        if self._value is None:
            self._value = self.support.kernel.value(self.distance, self.length, self.support.dimension)
        return self._value

    @property
    def inverse_square(self) -> Tensor:
        return 1.0 / (self.square + SINGULARITY * self.length**2)

    def value_at_zero(self) -> Tensor:
        """W(0) of every particle, (N,)."""
        zero = self.distance.new_zeros(self.count)
        return self.support.kernel.value(zero, self._length, self.support.dimension)

    def tensile_weight(self, reference: float) -> Tensor:
        at = self.support.kernel.value(torch.full_like(self.distance, reference), self.length, self.support.dimension)
        return (self.value / at) ** TENSILE_POWER

    def ends(self, field: Tensor) -> tuple[Tensor, Tensor]:
        return field.index_select(0, self.first), field.index_select(0, self.second)

    def first_of(self, field: float | Tensor) -> float | Tensor:
        return field.index_select(0, self.first) if isinstance(field, Tensor) and field.ndim else field

    def second_minus_first(self, field: Tensor) -> Tensor:
        a, b = self.ends(field)
        return b - a

    def collect(self, to_first: Tensor, to_second: Tensor) -> Tensor:
        """Add the contributions of each pair to both of its particles; (P, ...) twice -> (N, ...)."""
        total = to_first.new_zeros((self.count, *to_first.shape[1:]))
        return total.index_add(0, self.first, to_first).index_add(0, self.second, to_second)


def status(device: str) -> tuple[bool, str]:
    """Whether the backend can be used on ``device``, and why."""
    del device  # torch serves every one
    return True, "plain torch, any device, always present"
