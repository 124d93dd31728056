"""Walls of a vessel that its velocities contradict are believed less; walls that fit are believed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from regularize import Smoother, WallRows
from torchsph.methods.measurement.wall_trust import wall_trust

NOISE = 0.02


def field_and_rows(through: float):
    """A uniform flow along x with noise, and the wall z = 0, through which it would go at ``through`` m/s."""
    draw = np.random.default_rng(0)
    points = draw.uniform(0, 0.02, (1500, 3))
    velocity = np.array([0.4, 0.0, through]) + NOISE * draw.standard_normal(points.shape)
    fitted = Smoother(wall=None, no_slip=None).fit(
        torch.from_numpy(points), torch.from_numpy(velocity), uncertainty=True
    )
    place = np.linspace(0.002, 0.018, 9)
    wall = np.stack([*np.meshgrid(place, place), np.zeros((9, 9))], -1).reshape(-1, 3)
    normal = np.tile([0.0, 0.0, -1.0], (len(wall), 1))
    rows = WallRows(torch.from_numpy(wall), torch.from_numpy(normal), torch.zeros(len(wall), 3, dtype=torch.float64))
    return fitted, rows


def test_a_wall_that_the_flow_keeps_to_is_believed():
    """Within the spline's own deviation of the wall there is nothing to mistrust."""
    assert wall_trust(*field_and_rows(0.0), 2.0) > 0.9


@pytest.mark.slow
def test_a_wall_that_the_flow_goes_through_counts_by_how_much():
    """Its error is the speed through it: 1 / (1 + strength^2 speed^2 / noise^2)."""
    fitted, rows = field_and_rows(0.2)
    noise = float(fitted.choice.deviation.square().mean())
    assert wall_trust(fitted, rows, 2.0) == pytest.approx(1 / (1 + 4 * 0.2**2 / noise), rel=0.1)


def test_rows_that_share_a_patch_share_its_error():
    """Four rows for each square of a knot's size say together what one says: the error counts four times as much."""
    fitted, rows = field_and_rows(0.2)
    noise = float(fitted.choice.deviation.square().mean())
    area = fitted.knots.spacing[0] * fitted.knots.spacing[1] / 4
    dense = replace(rows, weight=torch.full((len(rows.points),), area, dtype=torch.float64))
    assert wall_trust(fitted, dense, 2.0) == pytest.approx(1 / (1 + 4 * 4 * 0.2**2 / noise), rel=0.1)
