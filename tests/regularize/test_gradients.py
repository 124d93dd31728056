"""Gradients through the solve against finite differences (float64)."""

import pytest
import torch
from regularize_cases import smoother

from regularize import InvalidInput

OPTIONS = smoother(knots=6e-3, divergence=3e-3, curvature=1e-3, wall=None, no_slip=None).fixed()


def samples(n=40, axes=2):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(n, axes, generator=generator, dtype=torch.float64) * 12e-3
    velocity = torch.randn(n, axes, generator=generator, dtype=torch.float64).requires_grad_()
    weight = (torch.rand(n, generator=generator, dtype=torch.float64) + 0.5).requires_grad_()
    return points, velocity, weight


@pytest.mark.parametrize("scaling", ["density", "thesis"])
def test_gradcheck_of_velocities_and_weights(scaling):
    points, velocity, weight = samples()
    curvature = 1e-3 if scaling == "density" else None
    options = OPTIONS.fixed(scaling=scaling, curvature=curvature, damping=0.1)

    def values(v, w):
        return options.fit(points, v, w)(points[::7] * 0.98)

    assert torch.autograd.gradcheck(values, (velocity, weight), eps=1e-6, atol=1e-6)


def test_gradient_of_the_divergence_flows_too():
    points, velocity, weight = samples(axes=3, n=60)
    loss = OPTIONS.fit(points, velocity, weight).divergence(points).square().sum()
    (gradient,) = torch.autograd.grad(loss, velocity)
    step = torch.zeros_like(velocity)
    step[5, 1] = 1e-4
    with torch.no_grad():
        up = OPTIONS.fit(points, velocity + step, weight).divergence(points).square().sum()
        down = OPTIONS.fit(points, velocity - step, weight).divergence(points).square().sum()
    assert float(gradient[5, 1]) == pytest.approx(float(up - down) / 2e-4, rel=1e-4)


def test_where_gradients_cannot_flow_they_are_refused():
    points, velocity, weight = samples()
    with pytest.raises(InvalidInput, match="gradients"):
        smoother().fit(points, velocity, weight)
    with pytest.raises(InvalidInput, match="gradients"):
        OPTIONS.fixed(solver="lsqr").fit(points, velocity, weight)
