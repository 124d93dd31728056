"""Wall models: the kernel's completeness against analytic integrals, potential against autodiff, no slip per time."""

import numpy as np
import pytest
import torch

import geometry
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.simulator.schemes.wall_models import CompleteKernelWall, PotentialWall
from torchsph.simulator.walls import closest as wall_closest
from torchsph.simulator.walls.completeness import KernelCompleteness
from torchsph.simulator.walls.fields import WallFields
from torchsph.simulator.walls.interface import CompleteWallSample, WallSample
from torchsph.simulator.walls.potential import damped_velocity, potential, potential_force

WENDLAND = kernel("wendland_c2")


def half_space_completeness(distance, h):
    """Integral of the kernel over the half-space x > -distance, by quadrature over plane slices (exact to 1e-6)."""
    support = WENDLAND.support * h
    x = torch.linspace(-support, support, 2001, dtype=torch.float64)
    radius = torch.linspace(0, support, 2001, dtype=torch.float64)
    slices = torch.stack(
        [torch.trapezoid(WENDLAND.value((radius**2 + s**2).sqrt(), h, 3) * 2 * torch.pi * radius, radius) for s in x]
    )
    keep = (x < distance).to(torch.float64)
    return float(torch.trapezoid(slices * keep, x)), float(np.interp(distance, x.numpy(), slices.numpy()))


def completeness_of(field, step, h):
    return KernelCompleteness(field.shape, step, WENDLAND, h, torch.float64).at(field)


def test_completeness_behind_a_tilted_plane_equals_the_analytic_half_space_integral():
    """As looked up between the nodes: on the average over places within 0.2 % of the kernel, anywhere within 1 %.

    The gradient, which transmits the wall's friction: 1 and 3.5 % of its largest value. Values that are right at the
    nodes, instead of on the average between them, put it 4 % too low at the wall, and a pipe flow 0.5 % too fast.
    """
    h, step = 1.3, 0.5
    normal = torch.tensor([0.36, 0.48, 0.8], dtype=torch.float64)
    axis = torch.arange(-7.0, 7.0 + step, step, dtype=torch.float64)
    grid = geometry.Grid((-7.0,) * 3, (step,) * 3, (len(axis),) * 3)
    completeness, gradient = completeness_of((grid.nodes() @ normal).reshape(grid.shape), step, h)
    aside = torch.rand((400, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 4 - 2
    aside = aside - (aside @ normal)[:, None] * normal
    largest = half_space_completeness(0.0, h)[1]
    for distance in (0.0, 0.4, 1.0, 2.0):
        values = grid.sample(torch.cat([completeness, gradient]), aside + distance * normal)
        expected, slope = half_space_completeness(distance, h)
        assert float(values[0].mean()) == pytest.approx(expected, abs=0.002)
        assert (values[0] - expected).abs().max() < 0.01
        along = normal @ values[1:]
        assert float(along.mean()) == pytest.approx(slope, abs=0.01 * largest)
        assert (along - slope).abs().max() < 0.035 * largest
        assert (values[1:] - along * normal[:, None]).abs().max() < 0.035 * largest


def test_completeness_in_a_right_angled_edge_is_a_quarter():
    """Within 3 %: the cell that holds the edge counts as cut by one plane."""
    h, step = 1.3, 0.5
    axis = torch.arange(-6.0, 6.0 + step, step, dtype=torch.float64)
    x, z = axis[None, None, :], axis[:, None, None]
    inside = torch.minimum(x, z)
    beyond = -torch.sqrt(x.clamp_max(0) ** 2 + z.clamp_max(0) ** 2)
    field = torch.where(inside > 0, inside, beyond).expand(-1, 9, -1)
    completeness, _ = completeness_of(field, step, h)
    corner = int((axis == 0).nonzero())
    assert float(completeness[0, corner, 4, corner]) == pytest.approx(0.25, abs=0.03)
    assert float(completeness[0, -1, 4, -1]) == pytest.approx(1.0, abs=1e-9)


def wall(distance, velocity=(0.0, 0.0, 0.0)):
    d = torch.as_tensor(distance, dtype=torch.float64)
    normal = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(len(d), 3)
    return WallSample(d, normal, torch.tensor([velocity], dtype=torch.float64).expand(len(d), 3))


def test_potential_force_is_minus_the_gradient_of_the_potential():
    model = PotentialWall(stiffness=0.3, reach=1.2)
    d = torch.tensor([-0.4, 0.1, 0.8, 1.1, 1.5], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(potential(model, 2.0, wall(d)).sum(), d)
    force = potential_force(model, 2.0, wall(d.detach()))
    torch.testing.assert_close(force[:, 2], -slope)
    assert force[-1].abs().max() == 0


def test_retardation_is_relative_to_the_wall_and_independent_of_the_step():
    """Errata to 3.2: n small steps do what one step of n times the length does; normal velocity stays."""
    model, at = PotentialWall(relaxation=0.7), wall([0.2], (0.5, 0.0, 0.3))
    start = torch.tensor([[2.0, -1.0, 0.9]], dtype=torch.float64)
    once = damped_velocity(model, 1.5, torch.tensor([0.4], dtype=torch.float64), start, at)
    stepped = start
    for _ in range(8):
        stepped = damped_velocity(model, 1.5, torch.tensor([0.05], dtype=torch.float64), stepped, at)
    torch.testing.assert_close(once, stepped)
    assert float(once[0, 2]) == 0.9
    assert 0.5 < float(once[0, 0]) < 2.0
    torch.testing.assert_close(damped_velocity(model, 1.5, torch.ones(1).double(), at.velocity, at), at.velocity)


def fields(surface, spacing=1e-3, model=None):
    motion = geometry.WallMotion.at_rest(surface)
    complete = isinstance(model or CompleteKernelWall(), CompleteKernelWall)
    return WallFields(motion, spacing, 1.0, WENDLAND, 1.3, complete, "cpu", torch.float64)


def test_look_up_fields_of_a_box_are_exact_near_its_sides():
    made = fields(geometry.box((0, 0, 0), (0.02, 0.012, 0.012), 2e-3))
    key = made.key(0, ())
    points = torch.tensor([[10.0, 6.0, 0.3], [10.0, 6.0, -0.4], [0.7, 6.0, 6.0]], dtype=torch.float64)
    seen = made.sample(made.between(key, key), torch.zeros(()).double(), points)
    torch.testing.assert_close(seen.distance, torch.tensor([0.3, -0.4, 0.7]).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(seen.normal[0], torch.tensor([0.0, 0, 1]).double(), atol=1e-6, rtol=0)
    assert isinstance(seen, CompleteWallSample)
    assert float(seen.completeness[0]) == pytest.approx(half_space_completeness(0.3, 1.3)[0], abs=0.012)


def test_potential_walls_store_no_completeness_of():
    made = fields(geometry.box((0, 0, 0), (0.02, 0.012, 0.012), 2e-3), model=PotentialWall())
    key = made.key(0, ())
    assert key.shape[0] == 7
    seen = made.sample(made.between(key, key), torch.zeros(()).double(), torch.ones(1, 3).double())
    assert not isinstance(seen, CompleteWallSample)


def test_an_open_orifice_is_no_wall():
    """Under the middle of the open inlet the nearest wall is its rim; the channel behind it counts as fluid."""
    ventricle = geometry.Ventricle()
    made = fields(ventricle.surface(1e-3), 1.5e-3)
    centre = torch.tensor([[ventricle.mitral_centre[0], 0.0, -0.5e-3]], dtype=torch.float64) / 1.5e-3
    above = centre * torch.tensor([1.0, 1.0, -1.0]).double()
    shut, opened = made.key(0, ()), made.key(0, (1,))
    zero = torch.zeros(()).double()
    assert float(made.sample(made.between(shut, shut), zero, centre).distance) == pytest.approx(1 / 3, abs=0.02)
    assert float(made.sample(made.between(opened, opened), zero, centre).distance) > 1.5
    assert float(made.sample(made.between(shut, shut), zero, above).distance) < 0
    assert float(made.sample(made.between(opened, opened), zero, above).distance) > 1.5
    assert (
        float(made.sample(made.between(opened, opened), zero, centre).completeness)
        > 0.9
        > float(made.sample(made.between(shut, shut), zero, centre).completeness)
    )


def folded_sheet():
    """A ventricle that moves unevenly, and its vertices' velocities: faces of many sizes and directions."""
    surface = geometry.Ventricle().surface(1.2e-3)
    return surface, np.stack([np.sin(400 * surface.vertices[:, k]) for k in range(3)], 1)


@pytest.mark.parametrize("dimension", [2, 3])
def test_compiled_closest_points_equal_those_of_the_tree(dimension):
    """Exactly where the distance is below the limit, and a bound from above that is no worse beyond it."""
    if dimension == 3:
        surface, values = folded_sheet()
        grid = geometry.Grid.covering(surface.vertices.min(0) - 4e-3, surface.vertices.max(0) + 4e-3, 1e-3)
        limit = np.full(grid.size, 3e-3)
    else:
        surface = geometry.polygon(np.array([[0, 0], [1, -0.1], [1.2, 1], [0.5, 0.3], [0.1, 0.8]]), 0.07)
        values = surface.vertices**2
        grid = geometry.Grid.covering((-0.3, -0.4), (1.5, 1.3), 0.03)
        limit = np.full(grid.size, 0.2)
    try:
        handle = wall_closest.library().handle
    except wall_closest.LibraryMissing as reason:
        pytest.skip(str(reason))
    distance, carried = wall_closest._compiled(handle, grid, surface, values, limit)
    expected, wanted = wall_closest.closest_by_tree(grid, surface, values, limit)
    true = wall_closest.SurfaceIndex(surface).query(grid.nodes().numpy())
    within = true.distance < limit
    assert 0.1 < within.mean() < 0.9
    np.testing.assert_allclose(distance[within], true.distance[within], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(expected[within], true.distance[within], rtol=1e-12, atol=1e-15)
    apart = np.abs(carried - wanted)[within].max(1)
    assert (apart < 1e-9).mean() > 0.98  # nodes as far from two faces as from each other may take either
    beyond = ~within
    assert (distance[beyond] >= true.distance[beyond] * (1 - 1e-12)).all()
    assert (distance[beyond] - true.distance[beyond]).max() < 0.5 * limit[0]


def test_without_compiled_code_the_fields_are_the_same(monkeypatch):
    compiled = fields(geometry.box((0, 0, 0), (0.02, 0.012, 0.012), 2e-3)).key(0, ())

    def missing():
        raise wall_closest.LibraryMissing

    monkeypatch.setattr(wall_closest, "library", missing)
    plain = fields(geometry.box((0, 0, 0), (0.02, 0.012, 0.012), 2e-3)).key(0, ())
    near = compiled[0].abs() < 1.5
    torch.testing.assert_close(compiled[:, near], plain[:, near], atol=1e-9, rtol=0)


@pytest.mark.parametrize("fault", ["not closed", "inside out"])
def test_walls_that_bound_no_fluid_are_refused(fault):
    brick = geometry.box((0, 0, 0), (0.02, 0.012, 0.012), 2e-3)
    faces = brick.faces[1:] if fault == "not closed" else brick.faces[:, ::-1]
    with pytest.raises(geometry.SurfaceError, match=fault):
        fields(geometry.Surface(brick.vertices, faces))


def test_walls_that_touch_themselves_bound_both_their_rooms():
    """Two boxes with a side in common: it is wall for both, and the distance is right on either side of it."""
    left, right = (geometry.box((x, 0, 0), (x + 0.012, 0.012, 0.012), 2e-3) for x in (0.0, 0.012))
    both = geometry.Surface(
        np.concatenate([left.vertices, right.vertices]), np.concatenate([left.faces, right.faces + len(left.vertices)])
    )
    made = fields(both)
    key = made.key(0, ())
    points = torch.tensor([[11.6, 6.0, 6.0], [12.7, 6.0, 6.0], [6.0, 6.0, -0.3]], dtype=torch.float64)
    seen = made.sample(made.between(key, key), torch.zeros(()).double(), points)
    np.testing.assert_allclose(seen.distance, [0.4, 0.7, -0.3], atol=1e-6)
    np.testing.assert_allclose(seen.normal, [[-1, 0, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)
