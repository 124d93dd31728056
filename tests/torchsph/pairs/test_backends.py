"""Backend battery: every term of every registered backend equals the float64 reference, in any arrangement.

A backend joins by its line in ``registry.BACKENDS``. Those that take no CPU tensors are skipped here, with the reason;
the Triton backend has ``test_triton.py``, which runs it on a GPU or by its interpreter.
"""

from __future__ import annotations

import dataclasses
import itertools

import pytest
import torch
from pair_cases import as_dtype, assert_close, changed, disordered, support

from torchsph.pairs import MomentumTerms, RateTerms, ReferenceBackend, available_backends, choose_backend
from torchsph.pairs.registry import BACKENDS
from torchsph.pairs.smoothing_kernels import KERNELS

FAST = [known.name for known in BACKENDS if known.name != "reference"]
PRESENT = {status.name: status for status in available_backends()}
DTYPES = [torch.float32, torch.float64]
REFERENCE = ReferenceBackend()

RATES = [
    RateTerms(continuity, *flags)
    for continuity, *flags in [
        ("volume", False, True, False, True),
        ("volume", False, False, False, False, False),
        ("mass", False, False, False, False, False),
        ("mass", False, False, True, False, False),
        ("volume", True, True, False, False, False),
        ("volume", True, True, True, True, True),
        ("mass", True, True, True, True, True),
        (None, False, False, True, False, False),
        (None, False, True, False, False, True),
        (None, True, False, False, True, False),
        (None, False, False, False, False, False),
        (None, False, False, False, False, True, True),
        ("volume", False, False, False, False, False, True, True, True),
        (None, False, False, False, True, False, False, False, True),
    ]
]


@pytest.fixture(params=FAST)
def fast(request):
    if not PRESENT[request.param].present:
        pytest.skip(f"backend '{request.param}': {PRESENT[request.param].reason}")
    return choose_backend(request.param)


def searched(fast, state, radius, period=None):
    wide = as_dtype(state, torch.float64)
    far = None if period is None else period.double()
    return (
        fast.search(state.position, state.member, radius, period=period),
        REFERENCE.search(wide.position, wide.member, radius, period=far),
        wide,
    )


def momentum_terms(dtype):
    nu = torch.tensor([0.1, 0.2], dtype=dtype)
    for form, artificial, laminar in itertools.product(
        ("symmetric", "sum", "switched", "difference", None), (None, 0.3), (None, nu)
    ):
        yield MomentumTerms(form, artificial, laminar)
    for artificial, laminar in ((None, None), (0.3, None), (None, nu), (0.3, nu)):
        yield MomentumTerms("symmetric", artificial, laminar, tensile=0.2, tensile_distance=1.0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("periodic", [False, True])
class TestTerms:
    """Every term alone and in company; two members with different smoothing lengths and viscosities."""

    def arrange(self, fast, dtype, dimension, periodic):
        side = 20 if dimension == 2 else 8
        state = disordered(side, dimension, dtype, members=2)
        lengths = support("wendland_c2", dimension, torch.tensor([1.2, 1.05], dtype=dtype))
        period = torch.full((dimension,), float(side), dtype=dtype) if periodic else None
        if periodic:
            period[0] = torch.inf
        return (state, lengths, *searched(fast, state, lengths.radius, period))

    def test_rates(self, fast, dtype, dimension, periodic):
        state, lengths, pairs, wanted_pairs, wide = self.arrange(fast, dtype, dimension, periodic)
        for terms in RATES:
            got = fast.rates(pairs, state, lengths, terms)
            assert_close(got, REFERENCE.rates(wanted_pairs, wide, lengths, terms), dtype)

    def test_momentum(self, fast, dtype, dimension, periodic):
        state, lengths, pairs, wanted_pairs, wide = self.arrange(fast, dtype, dimension, periodic)
        for terms in momentum_terms(dtype):
            got = fast.momentum(pairs, state, lengths, terms)
            assert_close(got, REFERENCE.momentum(wanted_pairs, wide, lengths, terms), dtype, str(terms))

    def test_both_passes_in_one(self, fast, dtype, dimension, periodic):
        state, lengths, pairs, wanted_pairs, wide = self.arrange(fast, dtype, dimension, periodic)
        alone = MomentumTerms(None, laminar=torch.tensor([0.1, 0.2], dtype=dtype))
        for rates, terms in itertools.product(RATES[:7], [alone, *list(momentum_terms(dtype))[::3]]):
            got = fast.right_hand_side(pairs, state, lengths, rates, terms)
            wanted = REFERENCE.right_hand_side(wanted_pairs, wide, lengths, rates, terms)
            assert_close(got[0], wanted[0], dtype)
            assert_close(got[1], wanted[1], dtype, str(terms))

    def test_laplacian(self, fast, dtype, dimension, periodic):
        state, lengths, pairs, wanted_pairs, wide = self.arrange(fast, dtype, dimension, periodic)
        for active in (None, state.deviation > -0.005):
            got = fast.laplacian(pairs, state, lengths, state.pressure, active)
            wanted = REFERENCE.laplacian(wanted_pairs, wide, lengths, wide.pressure, active)
            assert_close(got[0], wanted[0], dtype)
            assert_close(got[1], wanted[1], dtype)

    def test_poisson(self, fast, dtype, dimension, periodic):
        """The solution that conjugate gradients in torch find: with a start and without, some particles held at 0."""
        state, lengths, pairs, wanted_pairs, wide = self.arrange(fast, dtype, dimension, periodic)
        active = state.deviation > -0.015
        free = active & (state.pressure > -1.5)
        singular, single = torch.tensor([True, False]), dtype == torch.float32
        asked = {"free": free, "active": active, "singular": singular, "iterations": 500}
        for start in (None, 0.1 * wide.velocity[:, 0]):
            given = None if start is None else start.to(dtype)
            enough = 1e-5 if single else 1e-11
            got = fast.poisson(pairs, state, lengths, state.pressure, given, tolerance=enough, **asked)
            wanted = REFERENCE.poisson(wanted_pairs, wide, lengths, wide.pressure, start, tolerance=1e-12, **asked)
            torch.testing.assert_close(
                got.values.double(),
                wanted.values,
                rtol=0.0,
                atol=float(wanted.values.abs().max()) * (2e-4 if single else 1e-9),
            )
            torch.testing.assert_close(got.mismatch, wanted.mismatch, rtol=1e-6, atol=1e-7 if single else 1e-12)
            assert bool(got.converged.all()) and not bool(got.values[~free].any())
            assert bool((got.iterations <= wanted.iterations).all())
            short = fast.poisson(
                pairs, state, lengths, state.pressure, given, tolerance=1e-5, **{**asked, "iterations": 3}
            )
            assert not bool(short.converged.any()) and short.iterations.tolist() == [3, 3]

    def test_interpolation(self, fast, dtype, dimension, periodic):
        state, lengths, _, _, wide = self.arrange(fast, dtype, dimension, periodic)
        period = None
        if periodic:
            period = torch.full((dimension,), 20.0 if dimension == 2 else 8.0, dtype=dtype)
        fields = torch.cat([state.velocity, state.mass[:, None], state.pressure[:, None]], 1)
        query, member = state.position[::3] + 0.3, state.member[::3]
        for weight in (None, (state.mass - 1.02).clamp_min(0.0)):
            got = fast.interpolate(
                state.position, state.member, fields, lengths, query, member, period=period, weight=weight
            )
            wanted = REFERENCE.interpolate(
                wide.position,
                wide.member,
                fields.double(),
                lengths,
                query.double(),
                member,
                period=period,
                weight=None if weight is None else weight.double(),
            )
            assert_close(got, wanted, dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("name", sorted(KERNELS))
def test_every_smoothing_kernel(fast, name, dimension, dtype):
    state = disordered(14 if dimension == 2 else 7, dimension, dtype)
    choice = support(name, dimension, 1.5 if name == "spiky" else 1.1)
    pairs, wanted_pairs, wide = searched(fast, state, choice.radius)
    terms = RateTerms("volume", shepard=True, concentration=True)
    wanted = REFERENCE.rates(wanted_pairs, wide, choice, terms)
    assert_close(fast.rates(pairs, state, choice, terms), wanted, dtype)
    if name != "spiky":  # at the particle spacing the spiky kernel's value is too small a divisor
        tension = MomentumTerms("symmetric", tensile=0.2, tensile_distance=1.0)
        wanted = REFERENCE.momentum(wanted_pairs, wide, choice, tension)
        assert_close(fast.momentum(pairs, state, choice, tension), wanted, dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("dimension", [2, 3])
class TestArrangements:
    """The same particles moved, turned or renumbered give the same sums, moved, turned and renumbered."""

    terms = RateTerms("volume", diffusion=True, concentration=True, xsph=True)
    forces = MomentumTerms("switched", 0.1, 0.2)

    def sums(self, fast, state, choice):
        pairs = fast.search(state.position, state.member, choice.radius)
        return fast.right_hand_side(pairs, state, choice, self.terms, self.forces)

    def test_turned_and_moved(self, fast, dimension, dtype):
        state, choice = disordered(9, dimension, dtype), support("cubic", dimension)
        generator = torch.Generator().manual_seed(3)
        turn, _ = torch.linalg.qr(torch.randn((dimension, dimension), generator=generator, dtype=torch.float64))
        turn = turn.to(dtype)
        rates, acceleration = self.sums(fast, state, choice)
        moved = changed(state, lambda t: t)
        moved = type(moved)(
            state.position @ turn - 17.0,
            state.velocity @ turn,
            state.mass,
            state.deviation,
            state.pressure,
            state.member,
        )
        moved_rates, moved_acceleration = self.sums(fast, moved, choice)
        assert_close(moved_rates.divergence, rates.divergence, dtype)
        assert_close(moved_rates.concentration, rates.concentration @ turn, dtype)
        assert_close(moved_rates.xsph, rates.xsph @ turn, dtype)
        assert_close(moved_acceleration, acceleration @ turn, dtype)

    def test_renumbered(self, fast, dimension, dtype):
        state, choice = disordered(9, dimension, dtype, members=3), support("cubic", dimension)
        order = torch.randperm(state.member.numel(), generator=torch.Generator().manual_seed(4))
        rates, acceleration = self.sums(fast, state, choice)
        other_rates, other_acceleration = self.sums(fast, changed(state, lambda t: t[order]), choice)
        assert_close(other_rates.divergence, rates.divergence[order], dtype)
        assert_close(other_acceleration, acceleration[order], dtype)

    def test_list_with_margin_serves_moved_particles(self, fast, dimension, dtype):
        state, choice = disordered(9, dimension, dtype), support("cubic", dimension)
        pairs = fast.search(state.position, state.member, choice.radius, margin=0.4)
        generator = torch.Generator().manual_seed(5)
        push = torch.randn(state.position.shape, generator=generator, dtype=torch.float64).to(dtype)
        push = 0.199 * push / push.norm(dim=1, keepdim=True)
        moved = type(state)(
            state.position + push, state.velocity, state.mass, state.deviation, state.pressure, state.member
        )
        got = fast.rates(pairs, moved, choice, self.terms)
        assert_close(got, self.sums(fast, moved, choice)[0], dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("dimension", [2, 3])
def test_batch_is_bitwise_the_members_alone(fast, dimension, dtype):
    state = disordered(9, dimension, dtype, members=4)
    choice, terms, forces = support("wendland_c2", dimension), TestArrangements.terms, TestArrangements.forces
    pairs = fast.search(state.position, state.member, choice.radius)
    rates, acceleration = fast.right_hand_side(pairs, state, choice, terms, forces)
    for member in range(4):
        own = state.member == member
        alone = changed(state, lambda t: t[own])  # noqa: B023  (used at once)
        alone = dataclasses.replace(alone, member=torch.zeros_like(alone.member))
        pairs = fast.search(alone.position, alone.member, choice.radius)
        own_rates, own_acceleration = fast.right_hand_side(pairs, alone, choice, terms, forces)
        assert torch.equal(own_rates.divergence, rates.divergence[own])
        assert torch.equal(own_rates.xsph, rates.xsph[own])
        assert torch.equal(own_acceleration, acceleration[own])


def test_threads_change_nothing(fast):
    state, choice = disordered(24, 3, torch.float32), support("wendland_c2", 3)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            pairs = fast.search(state.position, state.member, choice.radius)
            results.append(fast.right_hand_side(pairs, state, choice, TestArrangements.terms, TestArrangements.forces))
    finally:
        torch.set_num_threads(before)
    for rates, acceleration in results[1:]:
        assert torch.equal(rates.divergence, results[0][0].divergence)
        assert torch.equal(acceleration, results[0][1])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("form", ["symmetric", "sum"])
def test_linear_momentum_is_conserved_to_round_off(fast, form, dimension, dtype):
    state, choice = disordered(10, dimension, dtype), support("wendland_c2", dimension)
    pairs = fast.search(state.position, state.member, choice.radius)
    terms = MomentumTerms(form, artificial=0.3, laminar=0.1)
    force = state.mass[:, None].double() * fast.momentum(pairs, state, choice, terms).double()
    epsilon = torch.finfo(dtype).eps
    assert float(force.sum(0).abs().max()) <= 20 * epsilon * float(force.abs().sum(0).max())


@pytest.mark.parametrize("dimension", [2, 3])
def test_angular_momentum_of_central_forces_is_conserved_to_round_off(fast, dimension):
    state, choice = disordered(10, dimension), support("wendland_c2", dimension)
    pairs = fast.search(state.position, state.member, choice.radius)
    force = state.mass[:, None] * fast.momentum(pairs, state, choice, MomentumTerms("sum", artificial=0.3))
    x, f = state.position, force
    torque = x[:, 0] * f[:, 1] - x[:, 1] * f[:, 0]
    assert abs(float(torque.sum())) <= 1e-13 * float(torque.abs().sum())


def test_a_pressure_that_cannot_be_found_says_so(fast):
    """A member with NaN in its source, one that is done at once, one that needs more iterations than it gets."""
    state, choice = disordered(6, 3, torch.float32, members=3), support("wendland_c2", 3)
    pairs = fast.search(state.position, state.member, choice.radius)
    source = torch.where(state.member == 1, torch.zeros_like(state.pressure), state.pressure)
    spoilt = torch.nonzero(state.member == 0)[3]
    source[spoilt] = float("nan")
    every = torch.ones(len(source), dtype=torch.bool)
    asked = {"free": every, "active": every, "singular": torch.ones(3, dtype=torch.bool), "tolerance": 1e-3}
    few = fast.poisson(pairs, state, choice, source, None, iterations=3, **asked)
    assert few.converged.tolist() == [False, True, False] and few.iterations.tolist() == [0, 0, 3]
    assert bool(torch.isnan(few.residual[0])) and float(few.residual[2]) > 1e-3
    enough = fast.poisson(pairs, state, choice, source, None, iterations=300, **asked)
    assert enough.converged.tolist() == [False, True, True]
    assert bool(torch.isfinite(enough.values[state.member > 0]).all())
