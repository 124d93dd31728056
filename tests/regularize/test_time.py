"""The time as a further axis, samples along a beam, and windows over long recordings."""

import pytest
import torch
from regularize_cases import smoother

from regularize import InvalidInput, WallRows

PLAIN = {"wall": None, "no_slip": None}
OPTIONS = smoother(automatic=None, robust=None, divergence=1e-3, curvature=1e-4, damping=1e-6)


def spacetime(n=1500, axes=2, seed=0, duration=0.1):
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(n, axes + 1, generator=generator, dtype=torch.float64)
    return points * torch.tensor([12e-3] * axes + [duration], dtype=torch.float64)


def swirl(points):
    """Divergence-free, cubic in space and time."""
    x, y, t = 100 * points[:, 0], 100 * points[:, 1], 10 * points[:, -1]
    parts = [y**2 * t**3 - y, x**2 * t - x**3]
    if points.shape[1] == 4:
        parts.append(x * y * t**2)
    return torch.stack(parts, dim=1)


@pytest.mark.parametrize("axes", [2, 3])
def test_polynomials_in_space_and_time_are_reproduced(axes):
    points = spacetime(2500, axes)
    options = OPTIONS.fixed(knots=6e-3, time_knots=0.05, curvature=1e-6, time_curvature=1e-4)
    field = options.fit(points, swirl(points))
    test = spacetime(100, axes, seed=1)
    test = test[field.supported(test)]
    assert len(test) > 90 and field.knots.axes == axes + 1 and field.components == axes
    assert torch.allclose(field(test), swirl(test), atol=1e-3)
    assert float(field.divergence(test).abs().max()) < 0.05  # against gradients of 100 1/s
    step = torch.zeros(axes + 1, dtype=torch.float64)
    step[-1] = 1e-6
    difference = (swirl(test + step) - swirl(test - step)) / 2e-6
    assert torch.allclose(field.gradient(test)[..., -1], difference, atol=0.2)


def test_time_curvature_smooths_over_time_alone():
    points = spacetime(3000)
    wobble = torch.stack([torch.sin(600 * points[:, -1]), torch.zeros_like(points[:, 0])], dim=1)
    loose = OPTIONS.fixed(time_knots=5e-3, time_curvature=1e-6, **PLAIN).fit(points, wobble)
    stiff = OPTIONS.fixed(time_knots=5e-3, time_curvature=30e-3, **PLAIN).fit(points, wobble)
    assert float(loose(points).square().mean()) > 0.2 > 0.01 > float(stiff(points).square().mean())


def test_moving_wall_rows_hold_at_their_times():
    points = spacetime(800)
    wall = spacetime(400, seed=2)
    wall[:, 0] = 0.0
    normals = torch.tensor([[1.0, 0.0]], dtype=torch.float64).expand(400, 2)
    speed = torch.stack([wall[:, -1], torch.zeros(400)], dim=1)
    options = OPTIONS.fixed(time_knots=0.05, divergence=None, wall=1e3, no_slip=None)
    rows = WallRows(wall, normals, speed)
    field = options.fit(points, torch.zeros(800, 2, dtype=torch.float64), wall=rows)
    assert torch.allclose(field(wall)[:, 0], wall[:, -1], atol=2e-3)


def test_automatic_choice_over_time():
    points = spacetime(6000, duration=0.5)
    x, y, t = (200 * points[:, 0], 200 * points[:, 1], 20 * points[:, 2])
    exact = torch.stack([torch.sin(y + t), torch.cos(x - t)], dim=1)
    noisy = exact + 0.3 * torch.randn(6000, 2, generator=torch.Generator().manual_seed(0)).double()
    field = smoother(knots=2e-3, time_knots=0.03, time_curvature=0.01).fit(points, noisy)
    assert field.choice.noise == pytest.approx((0.3, 0.3), rel=0.15)
    error = (field(points) - exact).square().mean().sqrt()
    assert float(error) < 0.1


def test_time_column_needs_time_knots():
    points = spacetime(100)
    with pytest.raises(InvalidInput, match="time_knots"):
        OPTIONS.fit(points, swirl(points))
    with pytest.raises(InvalidInput, match="nodes"):
        OPTIONS.fixed(knots=None, nodes=(6, 6), time_knots=0.05).fit(points, swirl(points))


def test_three_beams_restore_the_vectors():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(3000, 3, generator=generator, dtype=torch.float64) * 12e-3
    x, y, z = (150 * points).unbind(1)
    velocity = torch.stack([torch.sin(y), torch.cos(z), torch.sin(x)], dim=1)
    beam = torch.randn(3000, 3, generator=generator, dtype=torch.float64)
    beam /= beam.norm(dim=1, keepdim=True)
    seen = (velocity * beam).sum(1, keepdim=True) * beam
    field = OPTIONS.fixed(**PLAIN).fit(points, seen, beam=beam)
    inner = ((points > 1e-3) & (points < 11e-3)).all(1)
    assert torch.allclose(field(points)[inner], velocity[inner], atol=0.03)


def test_one_beam_leaves_the_other_components_to_the_penalties():
    points = spacetime(400)[:, :2]
    seen = torch.stack([torch.ones(400), torch.zeros(400)], dim=1).double()
    field = OPTIONS.fixed(damping=1e-3, **PLAIN).fit(points, seen, beam=torch.tensor([1.0, 0.0]))
    assert torch.allclose(field(points), seen, atol=0.02)


def test_bad_beams_are_named():
    points = spacetime(50)[:, :2]
    with pytest.raises(InvalidInput, match="length 1"):
        OPTIONS.fit(points, points, beam=2 * torch.ones(50, 2))
    with pytest.raises(InvalidInput, match="beam has shape"):
        OPTIONS.fit(points, points, beam=torch.ones(3, 2))
    with pytest.raises(InvalidInput, match="full vectors"):
        smoother().fit(points, points, beam=torch.tensor([1.0, 0.0]))
