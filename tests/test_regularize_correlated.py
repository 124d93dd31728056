"""Standard deviations under errors that neighbouring samples share, on data simulated without the model's own code."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from regularize import Smoother

NODES, STEP = 16, 1e-3  # per axis, m
LEVEL = (0.1, 0.1, 0.04)  # m/s


def grid():
    axis = torch.arange(NODES, dtype=torch.float64) * STEP
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def noise(width, seed):
    """(n, 3) white noise smoothed by a Gaussian of a full width at half maximum in nodes, of deviation LEVEL."""
    rng, margin, fields = np.random.default_rng(seed), 10, []
    for level in LEVEL:
        wide = rng.standard_normal((NODES + 2 * margin,) * 3)
        wide = gaussian_filter(wide, width / 2.3548) if width else wide
        part = wide[(slice(margin, -margin),) * 3]
        fields.append(torch.from_numpy(level * part / wide.std()).reshape(-1))
    return torch.stack(fields, dim=1)


def flow(points):
    x, y, z = (200 * points).unbind(1)
    return 0.3 * torch.stack([torch.sin(y) + torch.cos(z), torch.sin(z + 1), torch.cos(x) + torch.sin(y)], dim=1)


def z_scores(width, seeds):
    """Root mean square of (fit - truth) / std in the inner part, and of the same without the inflation."""
    points = grid()
    inner = ((points > 1.5 * STEP) & (points < (NODES - 2.5) * STEP)).all(1)
    now, before = [], []
    for seed in seeds:
        field = Smoother().fit(points, flow(points) + noise(width, seed), uncertainty=True)
        score = ((field(points) - flow(points)) / field.std(points))[inner]
        now.append(score)
        before.append(score * field.posterior.inflation)
    return tuple(float(torch.cat(each).square().mean().sqrt()) for each in (now, before))


def test_independent_errors_leave_the_posterior_as_it_is():
    now, before = z_scores(0, (0,))
    assert 0.93 * before < now <= before < 1.1


@pytest.mark.parametrize("width,least,most", [(2.0, 1.2, 1.25), (3.0, 1.7, 1.4)])
def test_correlated_errors_are_foreseen(width, least, most):
    """A posterior that counts every sample is too narrow by ``least``; with what they share it is right within most."""
    now, before = z_scores(width, (0, 1))
    assert before > least and 0.8 < now < most


def test_the_inflation_follows_the_data_and_not_their_units():
    points = grid()
    measured = flow(points) + noise(3.0, 5)
    inflation = Smoother().fit(points, measured, uncertainty=True).posterior.inflation
    scaled = Smoother(knots=30e-3, divergence=0.3, curvature=10e-3, no_slip=None, wall=None)
    again = scaled.fit(10 * points, measured, uncertainty=True).posterior.inflation
    assert float(inflation.min()) > 1.2 and torch.allclose(inflation, again, rtol=0.02)
