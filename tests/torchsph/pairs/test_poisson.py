"""Conjugate gradients on particles' equations: SciPy's solution, member by member, and what cannot be solved."""

import numpy as np
import pytest
import torch

from torchsph.pairs.poisson import PoissonProblem, solve

SIZES = (12, 20, 9)


def laplacians(generator):
    """One weighted graph Laplacian a member, symmetric under its weights, as a block diagonal (N, N); and weights."""
    blocks, weights = [], []
    for size in SIZES:
        edge = torch.rand((size, size), generator=generator, dtype=torch.float64)
        edge = torch.triu(edge, 1) + torch.triu(edge, 1).T
        weight = 0.5 + torch.rand(size, generator=generator, dtype=torch.float64)
        blocks.append((torch.diag(edge.sum(1)) - edge) / weight[:, None])
        weights.append(weight)
    return torch.block_diag(*blocks), torch.cat(weights)


def problem(matrix, weight, free=None, singular=True):
    member = torch.repeat_interleave(torch.arange(len(SIZES)), torch.tensor(SIZES))
    free = torch.ones(len(weight), dtype=torch.bool) if free is None else free
    flags = torch.full((len(SIZES),), singular)
    blocks = [matrix[member == m][:, member == m] for m in range(len(SIZES))]

    def apply(u):  # as pair sums do: a member never touches another's numbers
        return torch.cat([block @ u[member == m] for m, block in enumerate(blocks)])

    return PoissonProblem(apply, matrix.diagonal(), weight, free, flags, member, len(SIZES))


@pytest.fixture
def system():
    generator = torch.Generator().manual_seed(5)
    matrix, weight = laplacians(generator)
    return matrix, weight, torch.randn(len(weight), generator=generator, dtype=torch.float64)


def test_fixed_particles_make_it_a_plain_linear_system(system):
    matrix, weight, source = system
    free = torch.ones(len(weight), dtype=torch.bool)
    free[[0, 13, 40]] = False
    found = solve(problem(matrix, weight, free, singular=False), source, None, tolerance=1e-12, iterations=200)
    inner = free.numpy()
    expected = np.linalg.solve(matrix.numpy()[np.ix_(inner, inner)], source.numpy()[inner])
    np.testing.assert_allclose(found.values.numpy()[inner], expected, atol=1e-9)
    assert bool(found.converged.all()) and not found.values[~free].any() and not found.mismatch.any()


def test_a_source_with_a_mean_is_answered_without_it_and_says_so(system):
    """The least-squares solution under the weights: SciPy's lstsq on the source without its mean."""
    matrix, weight, source = system
    made = problem(matrix, weight)
    found = solve(made, source, None, tolerance=1e-12, iterations=200)
    for member, size in enumerate(SIZES):
        mine = made.member == member
        mean = float((weight * source)[mine].sum() / weight[mine].sum())
        assert float(found.mismatch[member]) == pytest.approx(mean, rel=1e-12)
        block, right = matrix[mine][:, mine].numpy(), source[mine].numpy() - mean
        expected = np.linalg.lstsq(block, right, rcond=None)[0]
        difference = found.values[mine].numpy() - expected
        assert np.ptp(difference) < 1e-9 * size  # equal up to a constant


def test_members_stop_by_themselves(system):
    """A member without a source takes no iteration, one with a NaN stops and spoils no other."""
    matrix, weight, source = system
    made = problem(matrix, weight)
    alone = solve(made, source, None, tolerance=1e-10, iterations=200)
    mixed = source.clone()
    mixed[made.member == 0] = 0.0
    mixed[-1] = float("nan")
    found = solve(made, mixed, None, tolerance=1e-10, iterations=200)
    assert found.iterations.tolist()[0] == 0 and bool(found.converged[0]) and not bool(found.converged[2])
    middle = made.member == 1
    torch.testing.assert_close(found.values[middle], alone.values[middle], rtol=0, atol=0)


def test_too_few_iterations_are_reported(system):
    matrix, weight, source = system
    found = solve(problem(matrix, weight), source, None, tolerance=1e-10, iterations=2)
    assert not found.converged.any() and found.iterations.tolist() == [2, 2, 2]
    assert bool((found.residual > 1e-10).all())


def test_a_good_start_saves_iterations(system):
    matrix, weight, source = system
    made = problem(matrix, weight)
    first = solve(made, source, None, tolerance=1e-8, iterations=200)
    again = solve(made, 1.001 * source, first.values, tolerance=1e-2, iterations=200)
    assert again.iterations.tolist() == [0, 0, 0] and bool(again.converged.all())
