"""The error of fits to noise-free samples falls with the knot distance: no damping or solver sets a floor."""

import pytest
import torch
from regularize_cases import smoother

LIGHT = smoother(divergence=1e-3, curvature=2e-5, damping=1e-6, wall=None, no_slip=None).fixed()
AXES = torch.tensor([40e-3, 20e-3, 20e-3], dtype=torch.float64)  # semi-axes of an ellipsoid, m


def inside(count, axes, generator):
    direction = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    direction /= direction.norm(dim=1, keepdim=True)
    return direction * torch.rand(count, 1, generator=generator, dtype=torch.float64) ** (1 / 3) * axes


def flow(points, waves):
    """Divergence-free, of order 1 m/s."""
    x, y, z = (waves * points / AXES).unbind(1)
    return torch.stack([torch.sin(y) + torch.cos(z), torch.sin(z) - torch.cos(x), torch.cos(x + y)], dim=1)


def errors(samples, grids, scale, waves, light=LIGHT):
    generator = torch.Generator().manual_seed(0)
    points, test = inside(samples, scale * AXES, generator), 0.97 * inside(3000, scale * AXES, generator)
    wanted = torch.cat([inside(2 * samples, scale * AXES, generator), test])
    for nodes in grids:
        fitted = light.fixed(knots=None, nodes=nodes).fit(points, flow(points, waves), divergence_points=wanted)
        yield float((fitted(test, outside=0.0) - flow(test, waves)).norm() / flow(test, waves).norm())


def test_noise_free_error_falls_from_grid_to_grid():
    found = list(errors(8000, ((10, 6, 6), (14, 8, 8), (20, 11, 11)), 0.5, 8.0))
    assert found[1] < 0.3 * found[0] and found[2] < 0.2 * found[1] and found[2] < 2e-3


def test_with_fewer_samples_than_coefficients_their_density_sets_the_error():
    """Not a floor of the method: more samples on the same fine grid lower it."""
    few, many = (next(errors(samples, ((20, 11, 11),), 0.5, 8.0)) for samples in (500, 8000))
    assert many < 0.1 * few


def test_third_derivatives_fill_the_gaps_between_few_samples():
    """With as few samples as cells, where least second derivatives let the error rise again from grid to grid."""
    grids = ((12, 8, 8), (18, 10, 10), (24, 13, 13))
    third = list(errors(850, grids, 0.35, 6.0, LIGHT.fixed(order=3, curvature=1e-4)))
    second = list(errors(850, grids[1:], 0.35, 6.0))
    assert third[0] > 1.7 * third[1] > 1.7 * 1.2 * third[2]
    assert second[1] > 1.5 * second[0] and second[1] > 3 * third[2]


@pytest.mark.slow  # 20 s and 2 GB; 64 x 32 x 32 is in examples/benchmarks/spline.py
def test_noise_free_error_falls_on_the_grids_of_the_thesis():
    found = list(errors(20000, ((16, 8, 8), (24, 12, 12), (32, 16, 16), (48, 24, 24)), 1.0, 6.0))
    assert all(fine < 0.4 * coarse for coarse, fine in zip(found[:-1], found[1:], strict=True)) and found[-1] < 3e-4
