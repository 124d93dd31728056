"""What every block of rows, and every system of them, must hold; the list is `regularize_cases.blocks_of`."""

import pytest
import torch
from regularize_cases import AXES, blocks_of, dense_of, system_of

from regularize import PreparedSystem, System, sparse_operators
from regularize.native import library as native
from regularize.rows.operators import PointRows

KINDS = tuple(blocks_of(2)[1])
ENGINES = ["reference", *(["native"] if native.available() else [])]
CASES = [(axes, degree) for axes in AXES for degree in (1, 2, 3, 5)]


def operator_of(kind, axes, degree):
    """One block by name, or the system of all of them."""
    if kind == "system":
        return system_of(axes, degree)
    blocks = blocks_of(axes, degree)[1]
    return blocks.get(kind) or pytest.skip(f"no {kind} rows of degree {degree}")


def shape_of(operator):
    """Of what the operator takes."""
    nodes, components = operator.knots.nodes, operator.components
    return (nodes * components,) if isinstance(operator, System) else (nodes, components)


def rows_of(operator):
    """Number of rows."""
    return len(operator.target() if isinstance(operator, System) else operator.target)


@pytest.mark.parametrize("kind", [*KINDS, "system"])
@pytest.mark.parametrize("axes, degree", CASES)
def test_adjoint_dot_test(kind, axes, degree):
    operator = operator_of(kind, axes, degree)
    generator = torch.Generator().manual_seed(7)
    x = torch.randn(shape_of(operator), generator=generator, dtype=torch.float64)
    y = torch.randn(rows_of(operator), generator=generator, dtype=torch.float64)
    left, right = torch.dot(operator.matvec(x), y), (x * operator.rmatvec(y)).sum()
    assert torch.isclose(left, right, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("kind", [*KINDS, "system"])
@pytest.mark.parametrize("axes", AXES)
def test_linear_and_equal_to_its_dense_matrix(kind, axes):
    operator = operator_of(kind, axes, 3 if axes == 2 else 2)
    dense = dense_of(operator)
    generator = torch.Generator().manual_seed(3)
    x = torch.randn(shape_of(operator), generator=generator, dtype=torch.float64)
    y = torch.randn(rows_of(operator), generator=generator, dtype=torch.float64)
    size = float(dense.abs().max())
    assert torch.allclose(operator.matvec(x), dense @ x.flatten(), atol=1e-12 * size)
    assert torch.allclose(operator.rmatvec(y).flatten(), dense.T @ y, atol=1e-12 * size)


@pytest.mark.parametrize("kind", [*KINDS, "system"])
def test_float32_agrees_with_float64(kind):
    operator = operator_of(kind, 3, 3)
    x = torch.randn(shape_of(operator), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    full, half = operator.matvec(x), operator.matvec(x.float())
    assert half.dtype == torch.float32
    assert torch.allclose(full.float(), half, atol=1e-5 * float(full.abs().max()))
    pulled = operator.rmatvec(full.float())
    assert pulled.dtype == torch.float32
    assert torch.allclose(pulled, operator.rmatvec(full).float(), atol=1e-4 * float(pulled.abs().max()))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("axes, degree", [(2, 1), (2, 3), (3, 2)])
def test_gram_and_gradient_equal_dense_products(engine, kind, axes, degree):
    block = operator_of(kind, axes, degree)
    system = System(block.knots, block.components, [block], 0.3)
    prepared = PreparedSystem(system, engine=engine)
    active = prepared.ordering.nodes
    a = dense_of(block).view(-1, block.knots.nodes, block.components)[:, active].flatten(1)
    normal, band = a.T @ a + 0.09 * torch.eye(a.shape[1], dtype=torch.float64), prepared.band()
    for offset in range(len(normal)):
        expected = normal.diagonal(-offset)
        found = band[: len(expected), offset] if offset < band.shape[1] else torch.zeros_like(expected)
        assert torch.allclose(found, expected, atol=1e-12 * float(normal.abs().max()))
    x = torch.randn(len(active), block.components, generator=torch.Generator().manual_seed(0)).double()
    gradient = a.T @ (system.target() - a @ x.flatten()) - 0.09 * x.flatten()
    assert torch.allclose(prepared.gradient(x).flatten(), gradient, atol=1e-10 * float(gradient.abs().max()))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("axes", AXES)
def test_stored_entries_equal_the_rows(kind, axes):
    block = operator_of(kind, axes, 2)
    system = System(block.knots, block.components, [block], 0.0)
    forward, adjoint = sparse_operators(system)
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(system.unknowns, generator=generator, dtype=torch.float64)
    r = torch.randn(len(block.target), generator=generator, dtype=torch.float64)
    assert torch.allclose(forward(x), system.matvec(x), atol=1e-11 * float(system.matvec(x).abs().max()))
    assert torch.allclose(adjoint(r), system.rmatvec(r), atol=1e-11 * float(system.rmatvec(r).abs().max()))


@pytest.mark.parametrize("kind", KINDS)
def test_rows_touch_the_coefficients_of_their_own_cells_alone(kind):
    block = operator_of(kind, 2, 3)
    near = torch.zeros(block.knots.nodes, dtype=torch.bool)
    near[block.knots.local_nodes(block.cell).flatten()] = True
    x = torch.randn(shape_of(block), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert torch.equal(block.matvec(x * near[:, None]), block.matvec(x))


@pytest.mark.parametrize("kind", KINDS)
def test_rows_at_points_scale_with_their_weight(kind):
    block = operator_of(kind, 2, 3)
    if not isinstance(block, PointRows):
        pytest.skip("rows of cells carry their weight in their factor")
    x = torch.randn(shape_of(block), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    values = block.matvec(x)
    block.weight = 2.0 * block.weight
    assert torch.allclose(block.matvec(x), 2.0 * values)
