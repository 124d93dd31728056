"""Walls that are displaced, against walls that lie there."""

import numpy as np
import pytest
import torch

import geometry
from torchsph import Scene, Simulator, preset
from torchsph.simulator.scene import Fluid
from torchsph.simulator.walls.displacement import WallDisplacement

SPACING = 1e-3


def ball(radius):
    """A ball of blood at rest."""
    walls = geometry.WallMotion.at_rest(geometry.ellipsoid((radius,) * 3, 4e-4))
    return Simulator(Scene(SPACING, walls=walls), preset("default"), dtype=torch.float64)


def fields_of(simulator):
    return simulator.domain.walls


def seen(fields, table, points):
    """Walls at points, m."""
    return fields.sample(fields.between(table, table), torch.zeros(()).double(), points / SPACING)


@pytest.fixture(scope="module")
def points():
    generator = torch.Generator().manual_seed(0)
    way = torch.nn.functional.normalize(torch.randn((400, 3), generator=generator, dtype=torch.float64), dim=1)
    return way * (2e-3 + 8e-3 * torch.rand((400, 1), generator=generator, dtype=torch.float64))


@pytest.mark.parametrize("amount", [3e-4, -3e-4])
def test_a_displaced_ball_is_a_larger_or_smaller_one(points, amount):
    walls = fields_of(ball(0.01))
    other = fields_of(ball(0.01 + amount))
    found = seen(walls, walls.displaced(0, (), WallDisplacement.checked(amount, None, 1)), points)
    wanted = seen(other, other.key(0, ()), points)
    near = wanted.distance < walls.reach
    # the finer grid of one ball is not the other's: they differ by what a look-up errs, a percent of the completeness
    torch.testing.assert_close(found.distance[near], wanted.distance[near], rtol=0, atol=0.02)
    torch.testing.assert_close(found.normal[near], wanted.normal[near], rtol=0, atol=0.03)
    torch.testing.assert_close(found.completeness, wanted.completeness, rtol=0, atol=0.02)


def test_shapes_go_with_the_nearest_place_of_the_wall(points):
    walls = fields_of(ball(0.01))
    vertices = walls.motion.vertices_at_keys[0]
    shapes = np.stack([vertices[:, 0], vertices[:, 2]]) / 0.01
    amount = torch.tensor([2e-4, -1e-4], dtype=torch.float64)
    displaced = walls.displaced(0, (), WallDisplacement.checked(amount, shapes, len(vertices)))
    plain = walls.key(0, ())
    far = points.norm(dim=1) > 7e-3  # as far in as distances are exact
    more = seen(walls, displaced, points[far]).distance - seen(walls, plain, points[far]).distance
    way = torch.nn.functional.normalize(points[far], dim=1)
    torch.testing.assert_close(more * SPACING, way[:, [0, 2]] @ amount, rtol=0, atol=5e-6)


def test_no_displacement_changes_no_bit_and_can_be_taken_back():
    simulator = ball(0.006)

    def after(displace):
        run = simulator.start(0.0, seed=1)
        run.particles = run.particles.changed(velocity=run.particles.position.flip(1) * 0.01)
        displace(run)
        run.advance(0.004)
        return run.particles

    plain, moved = after(lambda run: None), after(lambda run: run.displace_walls(2e-4))

    def there_and_back(run):
        run.displace_walls(2e-4)
        run.displace_walls(None)

    for same in (after(lambda run: run.displace_walls(0.0)), after(there_and_back)):
        assert torch.equal(same.velocity, plain.velocity) and torch.equal(same.position, plain.position)
    assert not torch.equal(moved.velocity, plain.velocity)


@pytest.mark.parametrize(
    ("amount", "shapes", "rule"),
    [
        (float("nan"), None, "finite number of m"),
        (torch.zeros(2), None, "no shapes are given"),
        (torch.zeros(2), np.zeros((2, 5)), "a column for each of the"),
        (torch.zeros((1, 1)), None, "one for each shape"),
        (torch.zeros(1), "infinite", "must be finite"),
    ],
)
def test_what_cannot_be_is_refused_with_the_rule(amount, shapes, rule):
    simulator = ball(0.006)
    if isinstance(shapes, str):
        shapes = np.full((1, simulator.scene.walls.vertices_at_keys.shape[1]), np.inf)
    with pytest.raises(ValueError, match=rule):
        simulator.start(0.0).displace_walls(amount, shapes)


def test_a_scene_without_walls_has_none_to_displace():
    scene = Scene(1 / 8, fluid=Fluid(1.0, 0.01), period=(1.0, 1.0), dimension=2)
    with pytest.raises(ValueError, match="no walls to displace"):
        Simulator(scene).start(0.0).displace_walls(0.01)
