"""The search for smoothness takes short cuts to the end that it would creep to."""

from __future__ import annotations

import pytest
import torch

import regularize
from regularize.basis.knots import Knots
from regularize.smoothing import search
from regularize.statistics import likelihood
from regularize.statistics.extrapolation import Extrapolation


def flow(noise=0.15, side=11):
    """Samples (n, 3) of waves in a cube of 6 cm with noise, m/s, and the truth."""
    generator = torch.Generator().manual_seed(3)
    axis = (torch.arange(side, dtype=torch.float64) + 0.5) * (0.06 / side)
    points = torch.cartesian_prod(axis, axis, axis)
    truth = torch.stack([torch.sin(70 * points[:, 1]), torch.cos(60 * points[:, 2]), torch.sin(50 * points[:, 0])], 1)
    return points, truth, truth + noise * torch.randn(truth.shape, generator=generator, dtype=torch.float64)


def chosen(**options):
    points, truth, samples = flow()
    smoother = regularize.Smoother(spacing=(0.06 / 11,) * 3, wall=None, no_slip=None, correlated=False, **options)
    field = smoother.fit(points, samples, divergence_points=points)
    return field.choice, float((field(points) - truth).norm() / truth.norm())


class Plain(Extrapolation):
    """The iteration as it is."""

    def next(self, place, mapped):
        return mapped


def test_coarser_knots_first_and_foretold_steps_lead_to_the_same_choice(monkeypatch):
    found, error = chosen()
    with monkeypatch.context() as patch:
        patch.setattr(search, "WORTH_COARSER", float("inf"))
        patch.setattr(likelihood, "Extrapolation", Plain)
        patch.setattr(likelihood, "SETTLED", 1e-4)
        crept, least = chosen(rounds=100)
    assert crept.settled and found.settled
    assert found.noise == pytest.approx(crept.noise, rel=0.02)
    assert found.curvature == pytest.approx(crept.curvature, rel=0.03)
    assert error == pytest.approx(least, rel=2e-3)


def test_the_short_cuts_are_shorter(monkeypatch):
    rounds = []
    before = likelihood.LikelihoodSearch._round

    def counted(self, now):
        rounds.append(self.unknowns)
        return before(self, now)

    monkeypatch.setattr(likelihood.LikelihoodSearch, "_round", counted)
    chosen()
    most, short = max(rounds), len([size for size in rounds if size == max(rounds)])
    rounds.clear()
    with monkeypatch.context() as patch:
        patch.setattr(search, "WORTH_COARSER", float("inf"))
        patch.setattr(likelihood, "Extrapolation", Plain)
        patch.setattr(likelihood, "SETTLED", 0.03)  # what leaves as much of the creeping iteration still to come
        chosen()
    assert set(rounds) == {most} and short < len(rounds)


def test_a_linear_iteration_is_at_its_end_after_as_many_steps_as_it_has_directions():
    generator = torch.Generator().manual_seed(1)
    turn = torch.linalg.qr(torch.randn(2, 2, generator=generator, dtype=torch.float64)).Q
    shrink = turn @ torch.diag(torch.tensor([0.7, -0.4], dtype=torch.float64)) @ turn.T
    end = torch.tensor([0.3, -0.2], dtype=torch.float64)

    def places(ahead, count):
        place = torch.zeros(2, dtype=torch.float64)
        for _ in range(count):
            place = ahead.next(place, end + shrink @ (place - end))
        return place

    first = Extrapolation()
    assert float((places(first, 3) - end).norm()) < 1e-9
    # another one like it knows them all from the start
    end = torch.tensor([-0.1, 0.4], dtype=torch.float64)
    assert float((places(Extrapolation(first), 1) - end).norm()) < 1e-9


def test_knots_that_are_spread_out_cover_the_same_box():
    knots = Knots((0.0, 0.1), (0.01, 0.02), (7, 5))
    wide = knots.spread_out(1.5)
    assert wide.spacing == pytest.approx((0.015, 0.03))
    for axis in range(2):
        low, high = knots.origin[axis], knots.origin[axis] + 0.01 * (axis + 1) * knots.cells[axis]
        assert wide.origin[axis] <= low + 1e-12
        assert wide.origin[axis] + wide.spacing[axis] * wide.cells[axis] >= high - 1e-12


def test_a_penalty_that_fades_is_off_and_never_beyond_what_options_hold():
    assert likelihood._strength(0.0) is None and likelihood._strength(1e-106) is None
    assert likelihood._strength(4.0) == 2.0 and likelihood._strength(1e300) == likelihood.MOST
    regularize.Smoother(no_slip=likelihood._strength(likelihood.LEAST**2 * 1.0001), divergence=None)
