"""The fit: exact reproduction, weights, walls, presets, masks, and refusals."""

import math
from dataclasses import replace

import pytest
import torch
from regularize_cases import smoother

from regularize import InvalidInput, NotConverged, PreparedSystem, Smoother, WallRows
from regularize.smoothing.knot_grid import knots_for
from regularize.smoothing.row_blocks import build_system
from regularize.smoothing.samples import FitData
from regularize.solvers.memory import band_bytes, device_memory

GIVEN = {"automatic": None, "robust": None}  # the options as they stand
PLAIN = {"divergence": None, "wall": None, "no_slip": None, "curvature": None, "damping": 1e-9, **GIVEN}


def cloud(n=600, axes=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    sides = torch.tensor((12e-3, 9e-3, 15e-3)[:axes], dtype=torch.float64)
    return torch.rand(n, axes, generator=generator, dtype=torch.float64) * sides


def rotation(points):
    """Divergence-free cubic field."""
    x, y, z = (points * 100).unbind(1)
    return torch.stack([y**3 - z, z**2 * x * 0 + x**3, x * y], dim=1)


def sphere(n, radius, centre):
    k = torch.arange(n, dtype=torch.float64)
    z, phi = 1 - (2 * k + 1) / n, k * math.pi * (3 - 5**0.5)
    r = (1 - z * z).sqrt()
    normals = torch.stack([r * phi.cos(), r * phi.sin(), z], dim=1)
    return centre + radius * normals, normals


@pytest.mark.parametrize("axes,degree", [(2, 3), (3, 3), (3, 4)])
def test_cubic_polynomials_are_reproduced(axes, degree):
    points = cloud(1500, axes)
    velocity = torch.stack([(100 * points[:, k]) ** 3 - 50 * points[:, 0] for k in range(axes)], dim=1)
    field = smoother(knots=3e-3, degree=degree, **PLAIN).fit(points, velocity)
    test = cloud(200, axes, seed=1) * 0.9 + 0.5e-3
    exact = torch.stack([(100 * test[:, k]) ** 3 - 50 * test[:, 0] for k in range(axes)], dim=1)
    assert torch.allclose(field(test), exact, atol=1e-6)


def test_derivatives_equal_autodiff_of_the_field():
    field = smoother().fit(cloud(), rotation(cloud()))
    point = cloud(5, seed=3).requires_grad_()
    value = field(point)
    for k in range(3):
        (row,) = torch.autograd.grad(value[:, k].sum(), point, retain_graph=True)
        assert torch.allclose(row, field.gradient(point)[:, k], atol=1e-9)
    trace = field.gradient(point).diagonal(dim1=1, dim2=2).sum(1)
    assert torch.allclose(field.divergence(point), trace)


def test_weight_power_means_weight_to_twice_the_power_in_the_cost():
    points, w = (
        cloud(),
        torch.rand(600, generator=torch.Generator().manual_seed(5), dtype=torch.float64) + 0.1,
    )
    velocity = rotation(points)
    squared = smoother(power=2.0, **GIVEN).fit(points, velocity, w).coefficients
    assert torch.allclose(squared, smoother(power=1.0, **GIVEN).fit(points, velocity, w**2).coefficients, atol=1e-10)
    assert not torch.allclose(squared, smoother(power=1.0, **GIVEN).fit(points, velocity, w).coefficients, atol=1e-4)


def test_doubled_samples_and_scaled_weights_change_nothing():
    points, velocity = cloud(), rotation(cloud())
    once = smoother(**GIVEN).fit(points, velocity).coefficients
    twice = smoother(**GIVEN).fit(points.repeat(2, 1), velocity.repeat(2, 1), torch.full((1200,), 0.5)).coefficients
    assert torch.allclose(once, twice, atol=1e-9)


def test_larger_box_changes_nothing_inside():
    points, velocity = cloud(), rotation(cloud())
    step, lower, upper = 3e-3, (0.0, 0.0, 0.0), (12e-3, 9e-3, 15e-3)
    small = smoother(knots=step, **GIVEN).fit(points, velocity, box=(lower, upper))
    wide = smoother(knots=step, **GIVEN).fit(points, velocity, box=([-2 * step] * 3, [u + 4 * step for u in upper]))
    assert torch.allclose(small(points), wide(points), atol=1e-8)


def test_moving_wall_right_hand_side():
    """An expanding sphere: strong wall rows give the wall's normal velocity, not zero."""
    centre = torch.tensor([6e-3, 6e-3, 6e-3], dtype=torch.float64)
    where, normals = sphere(400, 5e-3, centre)
    wall = WallRows(where, normals, 0.2 * normals, no_slip=torch.zeros(400, dtype=torch.bool))
    inside = sphere(200, 2e-3, centre)[0]
    options = smoother(divergence=None, wall=1e3, no_slip=None, curvature=0.5e-3, **GIVEN)
    field = options.fit(inside, torch.zeros_like(inside), wall=wall)
    assert torch.allclose((field(where) * normals).sum(1), torch.full((400,), 0.2, dtype=torch.float64), atol=5e-3)
    fixed = options.fit(inside, torch.zeros_like(inside), wall=WallRows(where, normals, 0 * normals))
    assert float(fixed(where).norm(dim=1).max()) < 1e-6


def test_no_slip_holds_the_whole_vector_and_only_where_asked():
    centre = torch.tensor([6e-3, 6e-3, 6e-3], dtype=torch.float64)
    where, normals = sphere(400, 5e-3, centre)
    inside = sphere(300, 4e-3, centre)[0]
    flow = torch.linalg.cross(inside - centre, torch.tensor([[0.0, 0, 50.0]], dtype=torch.float64).expand(300, 3))
    options = smoother(divergence=None, wall=100.0, no_slip=100.0, curvature=0.2e-3, **GIVEN)
    slip = torch.zeros(400, dtype=torch.bool)
    free = options.fit(inside, flow, wall=WallRows(where, normals, 0 * normals, no_slip=slip))
    held = options.fit(inside, flow, wall=WallRows(where, normals, 0 * normals, no_slip=~slip))
    assert float(held(where).norm(dim=1).mean()) < 0.1 * float(free(where).norm(dim=1).mean())


def test_strong_divergence_rows():
    points = cloud(2000)
    noisy = rotation(points) + 0.1 * torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)).double()
    field = smoother(divergence=0.1, **GIVEN).fit(points, noisy)
    free = smoother(divergence=None, **GIVEN).fit(points, noisy)
    ratio = [f.divergence(points).norm() / f.gradient(points).norm() for f in (field, free)]
    assert ratio[0] < 0.1 * ratio[1]


def test_thesis_preset_is_table_4_1():
    preset = Smoother.preset("thesis")
    assert (preset.nodes, preset.damping, preset.divergence, preset.wall, preset.power) == (
        (32, 16, 16),
        0.5,
        500.0,
        200.0,
        2.0,
    )
    assert preset.scaling == "thesis" and preset.curvature is None and preset.no_slip is None


def test_thesis_scaling_is_eq_3_22():
    """Rows written out by hand: sums, derivatives per mean knot spacing, divergence at the samples."""
    points, velocity = cloud(80), rotation(cloud(80))
    w = torch.rand(80, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    where, normals = sphere(20, 4e-3, torch.tensor([6e-3, 4.5e-3, 7e-3], dtype=torch.float64))
    preset = Smoother.preset("thesis", nodes=(7, 6, 5), divergence=5.0, wall=2.0)
    field = preset.fit(points, velocity, w, WallRows(where, normals, 0.1 * normals))
    knots = field.knots
    assert knots.shape == (7, 5, 6)  # array order z, y, x; the sides are 15, 9, 12 mm
    b = torch.zeros(80, knots.nodes, dtype=torch.float64)
    cell, t = knots.locate(points)
    b.scatter_(1, knots.local_nodes(cell), knots.stencil(t))
    derivative = []
    for k in range(3):
        d = torch.zeros_like(b)
        d.scatter_(1, knots.local_nodes(cell), knots.stencil(t, [int(a == k) for a in range(3)]))
        derivative.append(d * sum(knots.spacing) / 3)
    s = torch.zeros(20, knots.nodes, dtype=torch.float64)
    cell, t = knots.locate(where)
    s.scatter_(1, knots.local_nodes(cell), knots.stencil(t))
    a = torch.cat(
        [
            torch.block_diag(*[w[:, None] ** 2 * b] * 3),
            5.0 * torch.cat(derivative, 1),
            2.0 * torch.cat([normals[:, [k]] * s for k in range(3)], 1),
            0.5 * torch.eye(3 * knots.nodes, dtype=torch.float64),
        ]
    )
    right = torch.cat(
        [
            (w[:, None] ** 2 * velocity).T.flatten(),
            torch.zeros(80).double(),
            torch.full((20,), 0.2).double(),
            torch.zeros(3 * knots.nodes).double(),
        ]
    )
    c = torch.linalg.lstsq(a, right).solution.view(3, *knots.shape)
    assert torch.allclose(field.coefficients, c, atol=1e-8)


def test_solvers_and_precisions_agree():
    points, velocity = cloud(), rotation(cloud())
    options = smoother(divergence=3e-3, damping=1e-2, **GIVEN)
    direct = options.fit(points, velocity)(points)
    iterative = replace(options, solver="lsqr", tolerance=1e-8).fit(points, velocity)
    assert torch.allclose(iterative(points), direct, atol=1e-5)
    single = options.fit(points.float(), velocity.float())
    assert single.coefficients.dtype == torch.float32
    assert torch.allclose(single(points).double(), direct, atol=1e-4 * float(direct.abs().max()))


def test_the_solver_goes_by_size_and_memory(monkeypatch):
    points, velocity = cloud(), rotation(cloud())
    options = smoother(divergence=3e-3, damping=1e-2, **GIVEN)
    direct = options.fit(points, velocity)
    monkeypatch.setattr("regularize.smoothing.smoother.device_memory", lambda device: 1e6)
    small = options.fit(points, velocity)
    assert (direct.solution.solver, small.solution.solver) == ("direct", "lsmr")
    assert torch.allclose(small(points), direct(points), atol=1e-5)
    assert options.fit(points, velocity, uncertainty=True).solution.solver == "direct"  # it rests on the factor


@pytest.mark.parametrize("axes,degree", [(2, 1), (3, 3)])
def test_the_memory_of_a_factor_is_foreseen(axes, degree, monkeypatch):
    points = cloud(axes=axes)
    options = smoother(degree=degree, divergence=None, curvature=None, **GIVEN)
    data = FitData.checked(points, points)
    system = build_system(options, knots_for(data, options), data)
    band = PreparedSystem(system).band()
    bound = band_bytes(system)
    assert band.nbytes <= bound < 6 * band.nbytes
    monkeypatch.setattr("regularize.solvers.memory.WORTH_COUNTING", 0)
    assert band_bytes(system) == band.nbytes
    assert 1e8 < device_memory(torch.device("cpu")) < 1e14


def test_a_field_that_is_not_converged_comes_only_when_asked_for():
    points, velocity = cloud(), rotation(cloud())
    options = smoother(solver="lsmr", max_iterations=5, **GIVEN)
    with pytest.raises(NotConverged):
        options.fit(points, velocity)
    field = replace(options, strict=False).fit(points, velocity)
    assert field.solution.gradient > 1e-6 and "limit" in field.solution.reason and torch.isfinite(field(points)).all()


def test_the_order_of_the_penalty_says_which_polynomials_cost_nothing():
    points = cloud(1500)
    x, y = 100 * points[:, 0], 100 * points[:, 1]
    linear, quadratic = torch.stack([y, x, x], dim=1), torch.stack([y**2, x**2, x * y], dim=1)
    stiff = smoother(divergence=None, wall=None, no_slip=None, damping=1e-9, **GIVEN)
    for order, flow, kept in ((2, linear, True), (2, quadratic, False), (3, quadratic, True)):
        field = replace(stiff, curvature=30e-3, order=order).fit(points, flow)
        assert torch.allclose(field(points), flow, atol=1e-4) == kept


def test_unsupported_points_are_masked():
    points = cloud(axes=2)
    field = smoother().fit(points, points)
    beyond = torch.tensor([[5e-3, 5e-3], [50e-3, 5e-3]], dtype=torch.float64)
    assert field.supported(beyond).tolist() == [True, False]
    value = field(beyond)
    assert torch.isfinite(value[0]).all() and torch.isnan(value[1]).all()
    assert float(field(beyond, outside=0.0)[1].abs().max()) == 0
    assert torch.isnan(field.gradient(beyond)[1]).all() and torch.isnan(field.divergence(beyond)[1])


def test_export_to_grid():
    field = smoother().fit(cloud(), rotation(cloud()))
    grid = field.grid((1e-3, 2e-3, 3e-3), (1e-3, 1e-3, 2e-3), (4, 3, 2))
    point = torch.tensor([[2e-3, 4e-3, 9e-3]], dtype=torch.float64)  # i = 1, j = 2, k = 3
    assert grid.shape == (3, 4, 3, 2) and torch.allclose(grid[:, 3, 2, 1], field(point)[0])


@pytest.mark.parametrize("n", [1, 2])
def test_a_single_sample_or_coincident_ones(n):
    points = torch.full((n, 3), 5e-3, dtype=torch.float64)
    field = smoother().fit(points, torch.ones(n, 3, dtype=torch.float64), box=((0, 0, 0), (0.01, 0.01, 0.01)))
    assert torch.allclose(field(points), torch.ones(n, 3, dtype=torch.float64), atol=0.02)


def test_nan_is_allowed_only_under_zero_weight():
    points, velocity, w = cloud(), rotation(cloud()), torch.ones(600)
    velocity[3] = float("nan")
    with pytest.raises(InvalidInput, match="NaN"):
        smoother().fit(points, velocity, w)
    w[3] = 0
    assert torch.isfinite(smoother().fit(points, velocity, w).coefficients).all()


@pytest.mark.parametrize(
    "change,word",
    [
        ({"knots": -1.0}, "spacing|knots"),
        ({"degree": 6}, "degree"),
        ({"divergence": -1.0}, "divergence"),
        ({"solver": "magic"}, "solver"),
        ({"scaling": "other"}, "scaling"),
        ({"nodes": (8, 8, 8)}, "exactly one"),
        ({"power": -1.0}, "power"),
        ({"order": 4}, "order"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"automatic": "gcv", "choose_divergence": True}, "choose_divergence"),
        ({"divergence": None, "choose_divergence": True}, "choose_divergence"),
    ],
)
def test_bad_options_are_named(change, word):
    with pytest.raises(InvalidInput, match=word):
        smoother(**change).fit(cloud(), rotation(cloud()))


def test_bad_arrays_are_named():
    points, velocity = cloud(), rotation(cloud())
    with pytest.raises(InvalidInput, match="nothing to fit"):
        smoother().fit(points, velocity, torch.zeros(600))
    with pytest.raises(InvalidInput, match="outside the box"):
        smoother().fit(points, velocity, box=((0, 0, 0), (1e-3, 1e-3, 1e-3)))
    with pytest.raises(InvalidInput, match="weight"):
        smoother().fit(points, velocity, torch.ones(5))
    with pytest.raises(InvalidInput, match="normals"):
        WallRows(points, torch.zeros_like(points), velocity)
    with pytest.raises(InvalidInput, match="preset"):
        Smoother.preset("best")
