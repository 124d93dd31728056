"""The assembled normal matrix and its solution against dense algebra, compiled and in torch."""

import shutil

import pytest
import torch
from regularize_cases import blocks_of, make

from regularize import BlockFactor, InvalidInput, Knots, PreparedSystem, System, VectorRows, lsqr, solve_direct
from regularize.native import build as native_build
from regularize.native import library as native
from regularize.native import loader

ENGINES = [
    "reference",
    pytest.param("native", marks=pytest.mark.skipif(not native.available(), reason="not compiled")),
]


def dense_of(system):
    eye = torch.eye(system.unknowns, dtype=torch.float64)
    return torch.stack([system.matvec(column) for column in eye], dim=1)


def full(band):
    """Symmetric dense matrix of a lower band."""
    size, width = band.shape
    dense = torch.zeros(size, size, dtype=torch.float64)
    for offset in range(min(size, width)):
        dense += torch.diag(band[: size - offset, offset], -offset)
    return dense + torch.tril(dense, -1).T


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("axes,degree", [(2, 1), (2, 3), (2, 5), (3, 1), (3, 2), (3, 3)])
def test_band_and_gradient_equal_dense_products(axes, degree, engine):
    knots, blocks = blocks_of(axes, degree)
    system = System(knots, axes, list(blocks.values()), 0.3)
    prepared = PreparedSystem(system, engine=engine)
    a = dense_of(system).view(-1, knots.nodes, axes)[:, prepared.ordering.nodes].flatten(1)
    normal = a.T @ a + 0.09 * torch.eye(a.shape[1], dtype=torch.float64)
    assert torch.allclose(full(prepared.band()), normal, atol=1e-12 * float(normal.abs().max()))
    x = torch.randn(len(prepared.ordering.nodes), axes, generator=torch.Generator().manual_seed(0)).double()
    gradient = a.T @ (system.target() - a @ x.flatten()) - 0.09 * x.flatten()
    assert torch.allclose(prepared.gradient(x).flatten(), gradient, atol=1e-10 * float(gradient.abs().max()))
    assert torch.allclose(prepared.gradient().flatten(), a.T @ system.target(), atol=1e-12)
    log_determinant = float(torch.linalg.slogdet(normal)[1])
    assert prepared.factor().log_determinant() == pytest.approx(log_determinant, rel=1e-10)


@pytest.mark.parametrize("instruction_set", loader.PREFERENCE)
def test_every_compiled_variant_agrees(instruction_set, tmp_path, monkeypatch):
    if shutil.which("g++") is None or not native.available():
        pytest.skip("no compiler here")
    if not native.library().spline_runs(instruction_set.encode()):
        pytest.skip("this processor cannot run it")
    knots, blocks = blocks_of(3)
    prepared = PreparedSystem(System(knots, 3, list(blocks.values()), 0.3), engine="reference")
    monkeypatch.setenv(loader.FORCED, instruction_set)
    native.library.cache_clear()
    try:
        compiled = PreparedSystem(prepared.system, engine="native")
        assert torch.allclose(compiled.band(), prepared.band(), rtol=1e-10, atol=1e-12)
    finally:
        native.library.cache_clear()


def test_an_instruction_set_that_does_not_exist_is_refused(monkeypatch):
    if not native.available():
        pytest.skip("nothing was compiled here")
    monkeypatch.setenv(loader.FORCED, "avx1024")
    native.library.cache_clear()
    try:
        with pytest.raises(
            loader.LibraryMissing, match="TORCHSPH_ISA=avx1024 is unknown; known: avx512, avx2, baseline"
        ):
            native.library()
    finally:
        native.library.cache_clear()


@pytest.mark.slow
def test_build_makes_loadable_libraries(tmp_path, monkeypatch):
    if shutil.which("g++") is None:
        pytest.skip("no compiler here")
    made = native_build.build(tmp_path)
    assert made[0].name == "splines_baseline.so" and all(path.exists() for path in made)
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert native_build.build(tmp_path) == []


@pytest.mark.parametrize("axes,degree", [(2, 3), (3, 2), (3, 3), (2, 1)])
def test_direct_and_lsqr_equal_dense_least_squares(axes, degree):
    knots, blocks = blocks_of(axes, degree)
    system = System(knots, axes, list(blocks.values()), 0.3)
    a, b = dense_of(system), system.target()
    normal = a.T @ a + 0.09 * torch.eye(system.unknowns, dtype=torch.float64)
    dense = torch.linalg.solve(normal, a.T @ b)
    direct, _ = solve_direct(system, tolerance=1e-12)
    assert torch.allclose(direct.x, dense, atol=1e-11)
    iterative = lsqr(system.matvec, system.rmatvec, b, damping=0.3, tolerance=1e-11)
    assert torch.allclose(iterative.x, dense, atol=1e-8)


@pytest.mark.parametrize("engine", ENGINES)
def test_new_weights_at_the_same_points_need_no_new_preparation(engine):
    knots, blocks = blocks_of(3)
    prepared = PreparedSystem(System(knots, 3, list(blocks.values()), 0.3), engine=engine)
    change = torch.rand(len(blocks["vector"]), 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    other = System(knots, 3, [blocks["vector"].with_weight(change), *list(blocks.values())[1:]], 0.3)
    fresh, reweighed = PreparedSystem(other, engine="reference"), prepared.with_weights(other)
    assert torch.allclose(reweighed.band(), fresh.band(), atol=1e-12)
    x = torch.ones(len(prepared.ordering.nodes), 3, dtype=torch.float64)
    assert torch.allclose(reweighed.gradient(x), fresh.gradient(x), atol=1e-9)
    if engine == "native":
        with pytest.raises(InvalidInput, match="same points"):
            prepared.with_weights(System(knots, 3, list(blocks_of(3)[1].values()), 0.3))


def test_factor_serves_many_right_hand_sides():
    knots, blocks = blocks_of(2)
    prepared = PreparedSystem(System(knots, 2, list(blocks.values()), 0.3))
    factor, right = prepared.factor(), prepared.gradient()
    both = factor.solve(torch.stack([right, 2 * right], dim=-1))
    assert torch.allclose(both[..., 1], 2 * both[..., 0]) and torch.allclose(both[..., 0], factor.solve(right))


@pytest.mark.parametrize("axes,degree", [(2, 3), (3, 2), (2, 1)])
def test_block_tridiagonal_factor_equals_the_banded_one(axes, degree):
    knots, blocks = blocks_of(axes, degree)
    long = Knots(knots.origin, knots.spacing, (40, *knots.cells[1:]), degree)
    points = torch.rand(400, axes, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = points * torch.tensor(long.spacing).double() * torch.tensor(long.cells)
    weight = torch.ones(400, 1, dtype=torch.float64)
    prepared = PreparedSystem(System(long, axes, [VectorRows(long, points, points, weight)], 0.3))
    banded, block = prepared.factor(), BlockFactor(prepared.band(), prepared.ordering)
    right = torch.randn(len(prepared.ordering.nodes), axes, 3, generator=torch.Generator().manual_seed(1)).double()
    assert torch.allclose(block.solve(right), banded.solve(right), atol=1e-10)
    assert torch.allclose(block.solve(right[..., 0]), banded.solve(right[..., 0]), atol=1e-10)
    assert block.log_determinant() == pytest.approx(banded.log_determinant(), rel=1e-12)
    assert torch.allclose(block.diagonal(), banded.diagonal())
    assert len(block._lower) > 2
    with pytest.raises(InvalidInput, match="positive definite"):
        BlockFactor(-prepared.band(), prepared.ordering)


def test_coefficients_without_rows_stay_zero():
    knots = Knots((0.0, 0.0), (1.0, 1.0), (20, 3))
    _, _, draw, weight, _ = make(2)
    points = torch.rand(40, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2
    system = System(knots, 2, [VectorRows(knots, points, draw, weight[:, None])], 0.1)
    x = solve_direct(system)[0].x.view(*knots.shape, 2)
    assert float(x[:, 6:].abs().max()) == 0 and float(x[:5, :5].abs().min()) > 0


def test_singular_system_is_named():
    knots, points, draw, weight, _ = make(2, n=3)
    system = System(knots, 2, [VectorRows(knots, points, draw, weight[:, None])], 0.0)
    with pytest.raises(InvalidInput, match="curvature or damping"):
        solve_direct(system)


def test_float32_factor_refined_equals_float64():
    knots, blocks = blocks_of(3)
    system = System(knots, 3, list(blocks.values()), 0.3)
    double, _ = solve_direct(system, tolerance=1e-12)
    single, factor = solve_direct(system, tolerance=1e-12, single=True)
    assert factor.band.dtype == torch.float32 and single.gradient <= 1e-12 and single.iterations > 1
    assert torch.allclose(single.x, double.x, atol=1e-10)


@pytest.mark.parametrize("damping", [1e-6, 1e-4])
def test_float32_factor_that_fails_gives_way_to_float64(damping):
    knots, points, draw, _, _ = make(2, n=6)
    rows = VectorRows(knots, points, draw, torch.full((6, 1), 1e2, dtype=torch.float64))
    system = System(knots, 2, [rows], damping)
    solution, factor = solve_direct(system, tolerance=1e-6, single=True)
    assert factor.band.dtype == torch.float64 and solution.gradient <= 1e-6
