"""Defaults that are lengths or times go by the samples: the same flow in other units gives the same answer."""

import numpy as np
import pytest
import torch

from regularize import InvalidInput, Smoother, WallRows
from regularize.basis.sampling import space_steps, time_step
from regularize.smoothing import knot_grid
from regularize.smoothing.knot_grid import knots_for
from regularize.smoothing.samples import FitData

# Times a power of two all numbers keep their digits. Otherwise round-off turns the rows of penalties among themselves,
# and with them the draws by which the search estimates traces: to about 1 % each.
CASES = {
    "carotid": (0.25, 1.0, 1e-6),
    "adult": (3.0, 2.2, 0.03),
    "metres": (1024.0, 1.0, 1e-6),
    "slow": (0.7, 100.0, 0.03),
}


def lattice(steps, counts, seed=0):
    """Nodes (n, D) of a grid in an ellipsoid, in a random order."""
    axes = [h * torch.arange(n, dtype=torch.float64) for h, n in zip(steps, counts, strict=True)]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).flatten(0, -2)
    half = 0.5 * torch.tensor([h * (n - 1) for h, n in zip(steps, counts, strict=True)], dtype=torch.float64)
    inside = nodes[((nodes / half - 1) ** 2).sum(1) <= 1]
    return inside[torch.randperm(len(inside), generator=torch.Generator().manual_seed(seed))]


def vortex(points, size):
    """Divergence-free, m/s."""
    x, y = (torch.pi * (points[:, k] / size - 0.5) for k in range(2))
    parts = [torch.cos(x) * torch.sin(y), -torch.sin(x) * torch.cos(y)]
    return torch.stack([*parts, *[torch.zeros_like(x)] * (points.shape[1] - 2)], dim=1)


def noisy(points, size, sigma=0.2):
    return vortex(points, size) + sigma * torch.randn(points.shape, generator=torch.Generator().manual_seed(1)).double()


@pytest.mark.parametrize("automatic", [True, False])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("name", CASES)
def test_scaled_data_give_the_scaled_field(name, dimension, automatic):
    longer, slower, near = CASES[name]
    near = near if automatic else 1e-6
    points = lattice((1e-3,) * dimension, (15,) * dimension)
    velocity = noisy(points, 14e-3)
    side = points[points[:, 1] < 3e-3]
    side = side * torch.tensor([1.0, 0.0, 1.0][:dimension])  # where the vortex has no normal velocity
    normals = torch.eye(dimension, dtype=torch.float64)[1].expand(len(side), -1)
    options = Smoother() if automatic else Smoother().fixed()

    def field(length, time):
        wall = WallRows(
            length * side, normals, torch.zeros_like(side), no_slip=torch.zeros(len(side), dtype=torch.bool)
        )
        return options.fit(length * points, length / time * velocity, wall=wall)

    plain, scaled = field(1.0, 1.0), field(longer, slower)
    assert scaled.knots.cells == plain.knots.cells
    if automatic:
        assert scaled.choice.curvature == pytest.approx(longer * plain.choice.curvature, rel=10 * near)
    expected = longer / slower * plain(points)
    assert torch.allclose(scaled(longer * points), expected, atol=near * float(expected.abs().max()))


def test_scaled_data_over_time_give_the_scaled_field():
    space = lattice((1e-3, 1e-3), (11, 11))
    times = 0.01 * torch.arange(8, dtype=torch.float64)
    points = torch.cat([torch.cat([space, t.expand(len(space), 1)], dim=1) for t in times])
    velocity = noisy(points[:, :2], 10e-3)
    units = torch.tensor([0.25, 0.25, 4.0], dtype=torch.float64)
    plain = Smoother().fit(points, velocity)
    scaled = Smoother().fit(units * points, 0.25 / 4.0 * velocity)
    assert plain.knots.spacing == pytest.approx((3e-3, 3e-3, 0.03))
    expected = 0.25 / 4.0 * plain(points)
    assert torch.allclose(scaled(units * points), expected, atol=1e-5 * float(expected.abs().max()))


def test_steps_of_a_masked_grid_are_its_spacing_whatever_the_axes_and_the_precision():
    points = lattice((1e-3, 1.5e-3, 4e-3), (20, 15, 9))
    assert space_steps(points) == pytest.approx((1e-3, 1.5e-3, 4e-3))
    assert space_steps(points.float() + 0.1) == pytest.approx((1e-3, 1.5e-3, 4e-3), rel=1e-3)
    flat = points[points[:, 2] == points[0, 2]]
    assert space_steps(flat) == pytest.approx((1e-3, 1.5e-3, 1.5e-3))


@pytest.mark.parametrize("dimension", [2, 3])
def test_steps_of_scattered_samples_are_the_edge_of_the_cell_that_each_has(dimension):
    points = torch.rand(20000, dimension, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert space_steps(points) == pytest.approx((20000 ** (-1 / dimension),) * dimension, rel=0.1)
    # turned by any angle a grid is no lattice along the axes, and its cells are still as large
    grid = lattice((0.01,) * dimension, (40,) * dimension)
    c, s = np.cos(0.4), np.sin(0.4)
    turn = torch.eye(dimension, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[c, -s], [s, c]])
    assert space_steps(grid @ turn.T) == pytest.approx((0.01,) * dimension, rel=0.1)


def test_samples_at_one_point_or_without_frames_are_refused():
    with pytest.raises(InvalidInput, match="one point: give the knot distance"):
        space_steps(torch.ones(50, 3))
    with pytest.raises(InvalidInput, match="form no frames: give time_knots"):
        time_step(torch.rand(50))
    assert time_step(torch.tensor([0.0, 0.0, 0.02, 0.02, 0.04, 0.04])) == pytest.approx(0.02)


def test_a_known_kernel_keeps_knots_from_going_below_it():
    assert Smoother(resolution=3e-3).knots_at((0.5e-3,) * 3) == (3e-3,) * 3
    assert Smoother(resolution=3e-3).knots_at((0.5e-3, 0.5e-3, 2e-3)) == (3e-3, 3e-3, 6e-3)
    points = lattice((1e-3,) * 2, (15, 15))
    assert Smoother(resolution=5e-3).fixed().fit(points, points).knots.spacing == pytest.approx((5e-3, 5e-3))
    assert Smoother(knots=4e-3, resolution=9e-3).fixed().fit(points, points).knots.spacing == (4e-3, 4e-3)


def test_little_noise_lets_knots_be_finer_and_a_frame_that_follows_takes_the_same():
    points = lattice((1e-3,) * 2, (25, 25))
    loud = Smoother().fit(points, noisy(points, 24e-3, sigma=0.5))
    quiet = Smoother().fit(points, noisy(points, 24e-3, sigma=0.01))
    assert loud.knots.spacing == pytest.approx((3e-3, 3e-3)) and quiet.knots.spacing == pytest.approx((2e-3, 2e-3))
    after = Smoother().fit(points, noisy(points, 24e-3, sigma=0.01), choice=quiet.choice)
    assert after.knots == quiet.knots
    # a vortex of ten samples, which knots three samples apart do not resolve as well as its samples show it
    fine, wide = (Smoother(**k).fit(points, noisy(points, 10e-3, sigma=0.01)) for k in ({}, {"knots": 3e-3}))
    errors = [(field(points) - vortex(points, 10e-3)).square().mean().sqrt() for field in (fine, wide)]
    assert errors[0] < 0.7 * errors[1]


def test_what_the_options_say_stands_whatever_the_data():
    points = lattice((1e-3,) * 2, (15, 15))
    given = Smoother(knots=4e-3, divergence=7e-3, curvature=2e-3).fixed()
    filled = given.for_knots(given.fit(points, vortex(points, 14e-3)).knots.spacing, 2)
    assert (filled.knots, filled.divergence, filled.curvature) == (4e-3, 7e-3, 2e-3)
    off = Smoother().fixed(divergence=None, curvature=None).for_knots((1e-3, 1e-3), 2)
    assert off.divergence is None and off.curvature is None


@pytest.mark.parametrize("count", [12, 30, 45])
def test_work_of_automatic_knots_is_in_proportion_to_the_samples(count, monkeypatch):
    monkeypatch.setattr(knot_grid, "WORK_FREE", 1e7)
    monkeypatch.setattr(knot_grid, "WORK_PER_SAMPLE", 2e5)
    points = lattice((1e-3,) * 3, (count,) * 3)
    data = FitData.checked(points, points, None)
    knots = knots_for(data, Smoother())
    assert knot_grid._work(knots, data) <= max(1e7, 2e5 * len(points))
    assert knots.spacing[0] == pytest.approx(3e-3) if count == 12 else knots.spacing[0] > 3e-3


def test_unknowns_are_guarded_before_anything_is_allocated():
    points = torch.tensor([[0.0, 0.0, 0.0], [30.0, 20.0, 20.0]], dtype=torch.float64)  # in mm
    with pytest.raises(InvalidInput, match=r"ask for .* unknowns.*it is in m"):
        Smoother(knots=3e-3).fit(points, points)
    with pytest.raises(InvalidInput, match="unknowns"):
        Smoother(knots=None, nodes=(2000, 2000, 2000)).fit(points, points)


@pytest.mark.parametrize(
    "wrong", [{"knots": "wide"}, {"knots": -1e-3}, {"divergence": "all"}, {"resolution": 0.0}, {"wall": "auto"}]
)
def test_other_words_and_signs_are_refused(wrong):
    with pytest.raises(InvalidInput, match=next(iter(wrong))):
        Smoother(**wrong)
