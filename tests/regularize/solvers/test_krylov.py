"""LSQR against dense least squares and SciPy; its stop is the true gradient."""

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as sla
import torch
from regularize_cases import blocks_of

from regularize import NotConverged, System, lsmr, lsqr, sparse_matrix, sparse_operators


def problem(rows=60, columns=25, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    a = torch.randn(rows, columns, generator=generator, dtype=torch.float64) ** 3
    b = torch.randn(rows, generator=generator, dtype=torch.float64)
    w = torch.rand(rows, generator=generator, dtype=torch.float64) + 0.1
    apply = (lambda v: a.to(v.dtype) @ v), (lambda u: a.to(u.dtype).T @ u)
    return a, b.to(dtype), w.to(dtype), apply


@pytest.mark.parametrize("method", [lsqr, lsmr])
@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_equals_dense_weighted_least_squares(damping, method):
    a, b, w, (mv, rmv) = problem()
    stacked = torch.cat([w[:, None] * a, damping * torch.eye(25, dtype=torch.float64)])
    right = torch.cat([w * b, torch.zeros(25, dtype=torch.float64)])
    dense = torch.linalg.lstsq(stacked, right).solution
    found = method(mv, rmv, b, weight=w, damping=damping, tolerance=1e-12)
    assert torch.allclose(found.x, dense, rtol=1e-8, atol=1e-10)
    assert found.gradient <= 1e-12


def test_weights_inside_equal_weights_baked_into_the_matrix():
    a, b, w, (mv, rmv) = problem()
    baked = lsqr(lambda v: w * (a @ v), lambda u: a.T @ (w * u), w * b, tolerance=1e-12)
    inside = lsqr(mv, rmv, b, weight=w, tolerance=1e-12)
    assert torch.allclose(baked.x, inside.x, atol=1e-9)
    scipy = sla.lsqr((w[:, None] * a).numpy(), (w * b).numpy(), atol=1e-15, btol=1e-15)[0]
    assert np.allclose(inside.x.numpy(), scipy, atol=1e-8)


def test_zero_weight_rows_do_not_count():
    a, b, w, (mv, rmv) = problem()
    w[10:20] = 0
    changed = b.clone()
    changed[10:20] = 1e6
    one = lsqr(mv, rmv, b, weight=w, tolerance=1e-11).x
    assert torch.allclose(one, lsqr(mv, rmv, changed, weight=w, tolerance=1e-11).x, atol=1e-7)


@pytest.mark.parametrize("method", [lsqr, lsmr])
def test_float32_reaches_a_true_gradient_that_one_run_cannot(method):
    a, b, w, (mv, rmv) = problem(dtype=torch.float32)
    found = method(mv, rmv, b, weight=w, tolerance=1e-6)
    assert found.x.dtype == torch.float32 and found.gradient <= 1e-6


def test_non_convergence_is_raised_with_what_was_reached():
    _, b, w, (mv, rmv) = problem()
    with pytest.raises(NotConverged, match="iteration limit") as caught:
        lsqr(mv, rmv, b, weight=w, tolerance=1e-12, max_iterations=3)
    assert caught.value.solution.iterations == 3 and caught.value.solution.gradient > 1e-12
    loose = lsqr(mv, rmv, b, weight=w, tolerance=1e-12, max_iterations=3, strict=False)
    assert loose.gradient == caught.value.solution.gradient


def test_zero_right_side():
    _, b, w, (mv, rmv) = problem()
    found = lsqr(mv, rmv, torch.zeros_like(b), weight=w)
    assert float(found.x.abs().max()) == 0 and found.gradient == 0


@pytest.mark.parametrize("axes", [2, 3])
def test_stored_matrix_equals_the_operators(axes):
    knots, blocks = blocks_of(axes)
    system = System(knots, axes, list(blocks.values()), 0.1)
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(system.unknowns, generator=generator, dtype=torch.float64)
    r = torch.randn(len(system.target()), generator=generator, dtype=torch.float64)
    forward, adjoint = sparse_operators(system)
    assert torch.allclose(forward(x), system.matvec(x), atol=1e-9)
    assert torch.allclose(adjoint(r), system.rmatvec(r), atol=1e-9)
    assert forward(x.float()).dtype == torch.float32
    scipy = sla.aslinearoperator(to_scipy(sparse_matrix(system)))
    assert np.allclose(scipy.matvec(x.numpy()), system.matvec(x).numpy(), atol=1e-9)


def to_scipy(matrix):
    parts = matrix.values(), matrix.col_indices(), matrix.crow_indices()
    return sp.csr_matrix(tuple(part.numpy() for part in parts), shape=tuple(matrix.shape))
