"""Inputs that break neighbour searches: few, coinciding, crowded, stray, empty and unusable particles."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import pytest
import torch
from pair_cases import as_dtype, assert_close, changed, disordered, support

from torchsph.pairs import MomentumTerms, PairState, RateTerms, ReferenceBackend
from torchsph.pairs.registry import available_backends, choose_backend

DTYPES = [torch.float32, torch.float64]
RATES = RateTerms("volume", True, True, True, True, True)
FORCES = MomentumTerms("switched", artificial=0.3, laminar=0.1)
REFERENCE = ReferenceBackend()
PRESENT = {status.name: status for status in available_backends()}


@pytest.fixture(params=["cpu", "reference"])
def either(request):
    if not PRESENT[request.param].present:
        pytest.skip(f"backend '{request.param}': {PRESENT[request.param].reason}")
    return choose_backend(request.param)


def random_state(position: torch.Tensor, member: torch.Tensor | None = None) -> PairState:
    generator = torch.Generator().manual_seed(1)
    count, kind = position.shape[0], position.dtype

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64).to(kind)

    return PairState(
        position,
        normal(*position.shape),
        torch.ones(count, dtype=kind),
        0.01 * normal(count),
        normal(count),
        torch.zeros(count, dtype=torch.int64) if member is None else member,
    )


def doubled(sums):
    return changed(sums, lambda tensor: tensor.double())


def check(either, state: PairState, choice=None, margin: float = 0.0) -> None:
    """All sums of the backend are finite and equal the reference's in float64."""
    choice = choice or support("wendland_c2", state.position.shape[1])
    pairs = either.search(state.position, state.member, choice.radius, margin=margin)
    wide = as_dtype(state, torch.float64)
    wanted_pairs = REFERENCE.search(wide.position, wide.member, choice.radius)
    rates, acceleration = either.right_hand_side(pairs, state, choice, RATES, FORCES)
    wanted, wanted_acceleration = REFERENCE.right_hand_side(wanted_pairs, wide, choice, RATES, FORCES)
    assert torch.isfinite(acceleration).all()
    assert_close(rates, wanted, state.position.dtype)
    assert_close(acceleration, wanted_acceleration, state.position.dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("dimension", [2, 3])
class TestArrangements:
    def test_no_particle(self, either, dimension, dtype):
        state = random_state(torch.zeros((0, dimension), dtype=dtype))
        choice = support("wendland_c2", dimension)
        pairs = either.search(state.position, state.member, choice.radius)
        rates, acceleration = either.right_hand_side(pairs, state, choice, RATES, FORCES)
        assert acceleration.shape == (0, dimension)
        assert rates.renormalisation.shape == (0, dimension, dimension)

    def test_single_particle(self, either, dimension, dtype):
        state = random_state(torch.full((1, dimension), -3.0, dtype=dtype))
        choice = support("wendland_c2", dimension)
        pairs = either.search(state.position, state.member, choice.radius)
        rates, acceleration = either.right_hand_side(pairs, state, choice, RATES, FORCES)
        assert float(acceleration.abs().max()) == 0.0 == float(rates.divergence.abs().max())
        at_itself = choice.kernel.value(torch.zeros(1, dtype=dtype), 1.2, dimension)
        assert_close(rates.shepard_volume, (state.volume * at_itself).double(), dtype)

    def test_coinciding_particles(self, either, dimension, dtype):
        position = disordered(5, dimension, dtype).position
        check(either, random_state(torch.cat([position, position[:7], position[:1]])))

    def test_all_in_one_place(self, either, dimension, dtype):
        check(either, random_state(torch.full((100, dimension), 2.5, dtype=dtype)))

    def test_cell_with_a_hundred_times_the_particles(self, either, dimension, dtype):
        generator = torch.Generator().manual_seed(2)
        crowd = 0.3 * torch.rand((400, dimension), generator=generator, dtype=torch.float64).to(dtype)
        check(either, random_state(torch.cat([disordered(6, dimension, dtype).position, crowd])))

    def test_spacings_of_one_to_ten(self, either, dimension, dtype):
        """A disordered patch ten times finer, its particles as much lighter, in a disordered coarse lattice."""
        coarse, fine = disordered(6, dimension, dtype, seed=1), disordered(6, dimension, dtype, seed=2)
        outside = (coarse.position - coarse.position.mean(0)).abs().amax(1) > 0.8
        patch = coarse.position.mean(0) + 0.1 * (fine.position - fine.position.mean(0))
        state = random_state(torch.cat([coarse.position[outside], patch]))
        small = torch.arange(state.position.shape[0]) >= int(outside.sum())
        check(either, dataclasses.replace(state, mass=torch.where(small, 0.1**dimension, 1.0).to(dtype)))

    def test_vacuum_between_two_clouds(self, either, dimension, dtype):
        position = disordered(5, dimension, dtype).position
        check(either, random_state(torch.cat([position, position + 50.0, position - 31.0])))

    def test_strays_far_away(self, either, dimension, dtype):
        position = disordered(6, dimension, dtype).position
        strays = torch.tensor([[1e6] * dimension, [-3e7] * dimension, [1e12] * dimension], dtype=dtype)
        check(either, random_state(torch.cat([position, strays, strays + 0.0])))

    def test_line_of_particles(self, either, dimension, dtype):
        position = torch.zeros((500, dimension), dtype=dtype)
        position[:, -1] = torch.linspace(-250, 250, 500, dtype=torch.float64).to(dtype)
        check(either, random_state(position))

    def test_particles_exactly_at_the_support_radius(self, either, dimension, dtype):
        lattice = torch.cartesian_prod(*[torch.arange(6, dtype=torch.float64)] * dimension).to(dtype)
        check(either, random_state(lattice), support("wendland_c2", dimension, 1.0))

    def test_member_without_particles_and_unequal_members(self, either, dimension, dtype):
        position = torch.cat([disordered(6, dimension, dtype).position, disordered(3, dimension, dtype).position])
        member = torch.full((position.shape[0],), 4)
        member[6**dimension :] = 1
        check(either, random_state(position, member))

    def test_overlapping_members_do_not_see_each_other(self, either, dimension, dtype):
        one = disordered(6, dimension, dtype)
        both = changed(one, lambda t: torch.cat([t, t]))
        member = torch.cat([one.member, one.member + 1])
        both = dataclasses.replace(both, member=member)
        choice = support("cubic", dimension)
        alone = either.rates(either.search(one.position, one.member, choice.radius), one, choice, RATES)
        batch = either.rates(either.search(both.position, member, choice.radius), both, choice, RATES)
        half = one.member.numel()
        assert_close(batch.shepard_mass[:half], alone.shepard_mass.double(), dtype)
        assert_close(batch.shepard_mass[half:], alone.shepard_mass.double(), dtype)

    def test_lists_grow_where_the_first_guess_is_too_small(self, either, dimension, dtype):
        if either.name == "cpu":
            either.entries_per_particle = 0.01
        check(either, disordered(9, dimension, dtype))

    def test_lists_in_use_are_not_overwritten_by_the_next_search(self, either, dimension, dtype):
        state, other = disordered(9, dimension, dtype), disordered(9, dimension, dtype, seed=1)
        choice = support("cubic", dimension)
        pairs = either.search(state.position, state.member, choice.radius)
        before = either.rates(pairs, state, choice, RATES)
        kept = [either.search(other.position, other.member, choice.radius) for _ in range(3)]
        assert_close(either.rates(pairs, state, choice, RATES), doubled(before), dtype)
        del kept


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_position_that_is_not_finite(either, bad):
    state = disordered(4, 3)
    state.position[5, 1] = bad
    with pytest.raises(ValueError, match="1 particle position.*not finite"):
        either.search(state.position, state.member, 2.4)


def test_velocity_that_is_not_a_number_stays_in_its_member(either):
    state, choice = disordered(5, 3, torch.float32, members=2), support("cubic", 3)
    state.velocity[state.member == 0] = float("nan")
    pairs = either.search(state.position, state.member, choice.radius)
    rates, acceleration = either.right_hand_side(pairs, state, choice, RATES, FORCES)
    assert torch.isfinite(rates.divergence[state.member == 1]).all()
    assert torch.isfinite(acceleration[state.member == 1]).all()
    assert not torch.isfinite(rates.divergence[state.member == 0]).any()


def test_period_too_short(either):
    state = disordered(6, 3)
    with pytest.raises(ValueError, match="shorter than three search radii"):
        either.search(state.position, state.member, 2.4, period=torch.tensor([6.0, 100.0, 100.0]))


SMALL_SETS = """
import torch
from torchsph.pairs import choose_backend

backend, draw = choose_backend("cpu"), torch.Generator().manual_seed(0)
for count in range(9, 200):
    for _ in range(8):
        place = torch.tensor([4.7, 4.6, 7.0]) * torch.rand((count, 3), generator=draw, dtype=torch.{kind})
        backend.search(place, torch.zeros(count, dtype=torch.int64), 2.85)
print("through")
"""


@pytest.mark.parametrize("kind", ["float32", "float64"])
@pytest.mark.skipif(not PRESENT["cpu"].present, reason=PRESENT["cpu"].reason)
def test_small_sets_stay_inside_their_buffers(kind, tmp_path):
    """Registers of doubles wrote up to 12 bytes behind a list's buffer, which ended the process: so in a child."""
    program = [sys.executable, "-c", SMALL_SETS.format(kind=kind)]
    done = subprocess.run(program, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0 and done.stdout.strip() == "through", done.stderr[-500:]


def test_radius_not_positive(either):
    state = disordered(3, 3)
    with pytest.raises(ValueError, match="radius must be positive"):
        either.search(state.position, state.member, 0.0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("dimension", [2, 3])
def test_periodic_lattice_moved_across_its_boundary_changes_nothing(either, dimension, dtype):
    state, choice = disordered(9, dimension, dtype), support("cubic", dimension)
    period = torch.full((dimension,), 9.0, dtype=dtype)
    results = []
    for move in (0.0, 4.6, -23.0):
        moved = dataclasses.replace(state, position=state.position + move)
        pairs = either.search(moved.position, moved.member, choice.radius, period=period)
        results.append(either.right_hand_side(pairs, moved, choice, RATES, FORCES))
    for rates, acceleration in results[1:]:
        assert_close(rates, doubled(results[0][0]), dtype)
        assert_close(acceleration, results[0][1].double(), dtype)


def test_particle_that_wraps_between_search_and_pass(either):
    state, choice = disordered(9, 3), support("cubic", 3)
    period = torch.full((3,), 9.0, dtype=torch.float64)
    pairs = either.search(state.position, state.member, choice.radius, margin=0.2, period=period)
    wrapped = dataclasses.replace(state, position=torch.remainder(state.position, 9.0))
    wanted = either.rates(pairs, state, choice, RATES)
    assert_close(either.rates(pairs, wrapped, choice, RATES), wanted, torch.float64)


def test_terms_that_contradict_each_other():
    with pytest.raises(ValueError, match="tensile term belongs to the symmetric"):
        MomentumTerms("sum", tensile=0.2)
    with pytest.raises(ValueError, match="continuity must be one of"):
        RateTerms("density")
    with pytest.raises(ValueError, match="pressure must be one of"):
        MomentumTerms("antisymmetric")
