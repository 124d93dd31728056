"""Standard deviations under errors that neighbouring samples share, on data simulated without the model's own code."""

import numpy as np
import pytest
import torch
from regularize_cases import smoother
from scipy.ndimage import gaussian_filter

from regularize.statistics.waves import Lattice

PLAIN = smoother(correlated=False)  # the fit as for independent errors
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


INNER = ((grid() > 1.5 * STEP) & (grid() < (NODES - 2.5) * STEP)).all(1)


def rms(parts):
    return float(torch.cat(parts).square().mean().sqrt())


def z_scores(width, seeds):
    """Root mean square of (fit - truth) / std in the inner part, and of the same without the inflation."""
    now, before = [], []
    for seed in seeds:
        field = PLAIN.fit(grid(), flow(grid()) + noise(width, seed), uncertainty=True)
        score = ((field(grid()) - flow(grid())) / field.std(grid()))[INNER]
        now.append(score)
        before.append(score * field.posterior.inflation)
    return rms(now), rms(before)


def test_independent_errors_leave_the_posterior_as_it_is():
    now, before = z_scores(0, (0,))
    assert 0.93 * before < now <= before < 1.1


@pytest.mark.parametrize("width,least,most", [(2.0, 1.2, 1.25), (3.0, 1.7, 1.4)])
def test_correlated_errors_are_foreseen(width, least, most):
    """A posterior that counts every sample is too narrow by ``least``; with what they share it is right within most."""
    now, before = z_scores(width, (0, 1))
    assert before > least and 0.8 < now < most


@pytest.mark.slow
def test_shared_errors_weigh_less_in_the_fit():
    """Samples that share their errors are smoothed more, which is nearer to the truth; deviations stay right."""
    plain, counted, score = [], [], []
    for seed in (0, 1):
        measured = flow(grid()) + noise(3.0, seed)
        plain.append((PLAIN.fit(grid(), measured)(grid()) - flow(grid()))[INNER])
        field = smoother().fit(grid(), measured, uncertainty=True)
        counted.append((field(grid()) - flow(grid()))[INNER])
        score.append(counted[-1] / field.std(grid())[INNER])
        assert min(field.choice.shared) > 1.2
    assert rms(counted) < 0.93 * rms(plain) and 0.7 < rms(score) < 1.4


def test_waves_are_summed_by_axes_as_one_by_one():
    generator = torch.Generator().manual_seed(0)
    points = (grid() + 0.02)[torch.rand(NODES**3, generator=generator) < 0.6]
    waves, phase = 500 * torch.randn(3, 5, 2, generator=generator), torch.rand(5, 2, generator=generator)
    angles = phase.double() + torch.einsum("na,awd->nwd", points, waves.double())
    regular, scattered = Lattice(points), Lattice(points + 1e-4 * torch.rand(points.shape, generator=generator))
    assert regular.gridded and not scattered.gridded
    for found in (regular.sum_of_waves(waves, phase), regular._one_by_one(waves, phase)):
        assert torch.allclose(found.double(), angles.cos().sum(1), atol=1e-4)


def test_the_inflation_follows_the_data_and_not_their_units():
    points = grid()
    measured = flow(points) + noise(3.0, 5)
    inflation = PLAIN.fit(points, measured, uncertainty=True).posterior.inflation
    scaled = smoother(knots=30e-3, divergence=0.3, curvature=10e-3, correlated=False)
    again = scaled.fit(10 * points, measured, uncertainty=True).posterior.inflation
    assert float(inflation.min()) > 1.2 and torch.allclose(inflation, again, rtol=0.02)
