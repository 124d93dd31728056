"""Impose and fetch: exact for linear fields, masked where nothing is known."""

import math

import pytest
import torch

from geometry import Grid, WallMotion, box
from torchsph import Scene, Simulator
from torchsph.pairs import choose_backend
from torchsph.pairs.moving_least_squares import fetch_at
from torchsph.pairs.registry import available_backends
from torchsph.simulator.transfer.imposing import impose_at, pulled, wendland_weight

BACKENDS = [one.name for one in available_backends() if one.present]
SLOPE = torch.tensor([[0.3, -1.0, 0.2], [0.5, 0.1, -0.7], [1.1, 0.4, 0.9]], dtype=torch.float64)


def linear(points):
    d = points.shape[1]
    return points @ SLOPE[:d, :d].to(points.dtype).T + 1.0


def cloud(dimension, dtype, count=3000):
    generator = torch.Generator().manual_seed(3)
    side = 10.0 if dimension == 3 else 30.0
    return side, side * torch.rand(count, dimension, generator=generator, dtype=torch.float64).to(dtype)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 5e-4)])
def test_fetch_reproduces_linear_fields(name, dimension, dtype, tolerance):
    side, x = cloud(dimension, dtype)
    points = 2.0 + (side - 4.0) * torch.rand(200, dimension, dtype=dtype)
    label = torch.zeros(len(x), dtype=torch.int64)
    found = fetch_at(choose_backend(name), points, label[:200], x, label, linear(x), 2.0)
    assert found.covered.all()
    assert (found.value - linear(points)).abs().max() < tolerance


@pytest.mark.parametrize("dimension", [2, 3])
def test_impose_reproduces_linear_fields_whatever_the_weights(dimension):
    grid = Grid((0.0,) * dimension, (1.0,) * dimension, (9,) * dimension)
    field = linear(grid.nodes()).T.reshape(dimension, *grid.shape)
    weight = 0.1 + torch.rand(grid.shape, dtype=torch.float64)
    points = 2.0 + 4.0 * torch.rand(100, dimension, dtype=torch.float64)
    value, share = impose_at(points, grid, field, weight)
    torch.testing.assert_close(value, linear(points), rtol=0, atol=1e-11)
    assert (share > 0.1).all()


def test_impose_then_fetch_of_a_linear_field():
    grid = Grid((0.0,) * 3, (1.0,) * 3, (12,) * 3)
    field = linear(grid.nodes()).T.reshape(3, *grid.shape)
    _, x = cloud(3, torch.float64, 1500)
    carried, _ = impose_at(x, grid, field, torch.ones(grid.shape, dtype=torch.float64))
    inner = torch.cartesian_prod(*[torch.arange(3.0, 8.0, dtype=torch.float64)] * 3)
    label = torch.zeros(len(x), dtype=torch.int64)
    found = fetch_at(choose_backend("reference"), inner, label[: len(inner)], x, label, carried, 2.0)
    assert found.covered.all()
    torch.testing.assert_close(found.value, linear(inner), rtol=0, atol=1e-9)


def test_points_without_particles_are_uncovered_and_hold_zero():
    x = torch.rand(200, 3) * 3.0
    points = torch.tensor([[1.5, 1.5, 1.5], [30.0, 30.0, 30.0]])
    label = torch.zeros(200, dtype=torch.int64)
    found = fetch_at(choose_backend("reference"), points, label[:2], x, label, torch.ones(200, 3), 1.0)
    assert found.covered.tolist() == [True, False]
    assert found.value[1].tolist() == [0.0, 0.0, 0.0]


def test_particles_of_another_member_are_not_seen():
    x = torch.rand(400, 3) * 3.0
    member = (torch.arange(400) % 2).to(torch.int64)
    value = member.to(torch.float32)[:, None].expand(-1, 3).contiguous()
    points = torch.full((2, 3), 1.5)
    found = fetch_at(choose_backend("reference"), points, torch.tensor([0, 1]), x, member, value, 1.5)
    torch.testing.assert_close(found.value, torch.tensor([[0.0] * 3, [1.0] * 3]), atol=1e-5, rtol=0)


def test_neighbours_in_a_plane_give_their_mean_not_a_wild_slope():
    x = torch.cartesian_prod(torch.arange(5.0), torch.arange(5.0), torch.zeros(1)).double()
    label = torch.zeros(25, dtype=torch.int64)
    found = fetch_at(
        choose_backend("reference"), torch.tensor([[2.0, 2.0, 0.7]]).double(), label[:1], x, label, x[:, :1] + 3.0, 2.0
    )
    assert float(found.value) == pytest.approx(5.0, abs=1e-6)


def test_missing_nodes_may_be_nan():
    grid = Grid((0.0,) * 2, (1.0,) * 2, (6, 6))
    field, weight = torch.ones(2, 6, 6, dtype=torch.float64), torch.ones(6, 6, dtype=torch.float64)
    field[:, 2, 3], weight[2, 3] = math.nan, 0.0
    value, _ = impose_at(torch.tensor([[2.6, 2.2]], dtype=torch.float64), grid, field, weight)
    torch.testing.assert_close(value, torch.ones(1, 2, dtype=torch.float64))


def test_pull_follows_the_gain():
    grid = Grid((0.0,) * 3, (1.0,) * 3, (5, 5, 5))
    target, ones = torch.full((3, 5, 5, 5), 2.0), torch.ones(5, 5, 5)
    at = torch.tensor([[2.1, 2.0, 1.9]])
    half = pulled(at, torch.zeros(1, 3), grid, target, 0.25 * ones, ones)
    torch.testing.assert_close(half, torch.full((1, 3), 0.5))
    far = pulled(torch.tensor([[90.0, 0, 0]]), torch.ones(1, 3), grid, target, ones, ones)
    torch.testing.assert_close(far, torch.ones(1, 3))


def test_weight_is_one_at_zero_and_vanishes_at_its_radius():
    torch.testing.assert_close(wendland_weight(torch.tensor([0.0, 1.0, 2.0])), torch.tensor([1.0, 0.0, 0.0]))


def test_pulling_leaves_what_no_node_reaches_alone():
    """Also just inside the reach of the last node, where the weights underflow."""
    grid = Grid(origin=(0.0, 0.0, 0.0), spacing=(1.0, 1.0, 1.0), shape=(4, 4, 4))
    points = torch.tensor([[1.5, 1.5, 1.5], [4.999999, 1.0, 1.0], [9.0, 9.0, 9.0]])
    velocity = torch.full((3, 3), 2.0)
    gain = torch.ones(4, 4, 4)
    moved = pulled(points, velocity, grid, torch.zeros(3, 4, 4, 4), gain, gain)
    torch.testing.assert_close(moved, torch.tensor([[0.0] * 3, [2.0] * 3, [2.0] * 3]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_beyond_the_walls_a_node_has_what_flows_before_them(dtype):
    """A shear v_y = 50 x ends at x = 10 mm: a node .6 mm farther out has .5 m/s, not the .53 of a slope carried on."""
    spacing = 1e-3
    scene = Scene(spacing=spacing, walls=WallMotion.at_rest(box((-0.01,) * 3, (0.01,) * 3, 2e-3)))
    run = Simulator(scene, dtype=dtype).start(0.0)
    grid = Grid.covering((-0.0106,) * 3, (0.0106,) * 3, 0.4e-3)
    x, y, z = grid.nodes(dtype=torch.float64).T
    velocity = torch.zeros((3, grid.size), dtype=torch.float64)
    velocity[1] = 50.0 * x
    everywhere = torch.ones(grid.shape, dtype=torch.bool)
    run.impose(grid, velocity.reshape(3, *grid.shape), everywhere)
    found = run.fetch(grid, everywhere)
    value, middle = found.value[0, 1].flatten().double(), (y.abs() < 5e-3) & (z.abs() < 5e-3)
    inside = middle & (x.abs() < 0.0099)
    beyond = middle & (x > 0.0105)
    assert int(beyond.sum()) > 100
    assert bool(found.covered.flatten()[middle].all())
    assert float((value - 50.0 * x)[inside].abs().max()) < 5e-3
    assert float((value[beyond] - 0.5).abs().max()) < 0.01
