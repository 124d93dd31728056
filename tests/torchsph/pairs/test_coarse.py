"""The compiled solver's coarse level: fewer iterations to the same answer, whatever the batch and the threads."""

from dataclasses import replace

import pytest
import torch
from pair_cases import disordered, support

from torchsph.native.library import LibraryMissing
from torchsph.pairs import choose_backend

RADIUS = 2.6


@pytest.fixture(scope="module")
def backends():
    try:
        return choose_backend("cpu"), choose_backend("reference")
    except LibraryMissing as missing:
        pytest.skip(str(missing))


def at_rest(*arguments, **options):
    """Disordered particles of rest density, as incompressible steps have them: masses are then volumes."""
    state = disordered(*arguments, **options)
    return replace(state, deviation=torch.zeros_like(state.deviation))


def solved(solver, state, source, *, free=None, tolerance=1e-6, iterations=400):
    members = int(state.member.max()) + 1
    active = torch.ones_like(state.member, dtype=torch.bool)
    free = active if free is None else free
    pairs = solver.search(state.position, state.member, RADIUS)
    pinned = torch.tensor([bool((~free)[state.member == m].any()) for m in range(members)])
    return solver.poisson(
        pairs,
        state,
        support("wendland_c2", state.position.shape[1], 1.3),
        source,
        None,
        free=free,
        active=active,
        singular=~pinned,
        tolerance=tolerance,
        iterations=iterations,
    )


@pytest.mark.parametrize("dimension, per_side, part", [(2, 40, 0.5), (3, 14, 0.75)])
def test_long_waves_take_fewer_iterations(backends, dimension, per_side, part):
    """A source as long as the fluid; the more particles lie along it, the more the diagonal alone has to do."""
    state = at_rest(per_side, dimension)
    source = torch.sin(state.position[:, 0] * torch.pi / per_side)
    fast, plain = (solved(one, state, source) for one in backends)
    assert bool(fast.converged.all()) and bool(plain.converged.all())
    assert int(fast.iterations) < part * int(plain.iterations)
    difference = fast.values - plain.values
    assert float(difference.std() / plain.values.std()) < 1e-4


def test_held_particles_count_in_the_coarse_level(backends):
    state = at_rest(30, 2)
    free = state.position[:, 1] < state.position[:, 1].max() - 2.0
    fast, plain = (solved(one, state, state.pressure, free=free, tolerance=1e-10) for one in backends)
    assert bool(fast.converged.all()) and int(fast.iterations) < 0.6 * int(plain.iterations)
    torch.testing.assert_close(fast.values, plain.values, rtol=0, atol=1e-7 * float(plain.values.abs().max()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_member_is_solved_as_alone_on_any_number_of_threads(backends, dtype):
    """To the last bit: ranks share out the members of an ensemble."""
    fast, _ = backends
    state = at_rest(9, 3, dtype, members=3)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        together = solved(fast, state, state.pressure, tolerance=1e-3)
        torch.set_num_threads(1)
        for member in range(3):
            mine = state.member == member
            alone = type(state)(
                state.position[mine],
                state.velocity[mine],
                state.mass[mine],
                state.deviation[mine],
                state.pressure[mine],
                torch.zeros(int(mine.sum()), dtype=torch.int64),
            )
            found = solved(fast, alone, alone.pressure, tolerance=1e-3)
            assert torch.equal(found.values, together.values[mine])
            assert int(found.iterations) == int(together.iterations[member])
    finally:
        torch.set_num_threads(before)


def test_groups_that_share_clusters_do_without(backends):
    """Parts that hang apart have a constant each, and a cluster may hold both."""
    fast, plain = backends
    state = at_rest(12, 2)
    part = (state.position[:, 0] > state.position[:, 0].mean()).to(torch.int64)
    shifted = state.position.clone()
    shifted[:, 0] += 6.0 * part
    state = type(state)(shifted, state.velocity, state.mass, state.deviation, state.pressure, state.member)
    everything = torch.ones_like(part, dtype=torch.bool)
    values = []
    for one in (fast, plain):
        found = one.poisson(
            one.search(shifted, state.member, RADIUS),
            state,
            support("wendland_c2", 2, 1.3),
            state.pressure,
            None,
            free=everything,
            active=everything,
            singular=torch.tensor([True, True]),
            tolerance=1e-10,
            iterations=400,
            group=part,
        )
        assert bool(found.converged.all())
        values.append(torch.cat([found.values[part == k] - found.values[part == k].mean() for k in (0, 1)]))
    torch.testing.assert_close(values[0], values[1], rtol=0, atol=1e-7 * float(values[1].abs().max()))
