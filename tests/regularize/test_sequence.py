"""Temporal blur and windows over time."""

import pytest
import torch
from regularize_cases import smoother

from regularize import InvalidInput, blur_in_time, fit_windows

OPTIONS = smoother(wall=None, no_slip=None, divergence=1e-3, curvature=2e-4).fixed()
BOX = ((0.0, 0.0), (12e-3, 12e-3))


def points_of(seed, n=400, axes=2):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(n, axes, generator=generator, dtype=torch.float64) * 12e-3


def test_blur_averages_noise_and_keeps_what_is_steady_or_linear_in_time():
    where, fields, times = points_of(0), [], [0.00, 0.01, 0.02, 0.03, 0.04]
    for time in times:
        flow = torch.stack([torch.full((400,), 1.0 + 10 * time), torch.zeros(400)], dim=1).double()
        fields.append(OPTIONS.fit(where, flow, box=BOX))
    blurred = blur_in_time(fields, times, 0.005)
    inner = where[(where > 1e-3).all(1) & (where < 11e-3).all(1)]
    assert torch.allclose(blurred[2](inner), fields[2](inner), atol=1e-5)  # symmetric neighbours
    assert torch.allclose(blur_in_time(fields, times, 0.0)[0].coefficients, fields[0].coefficients)
    noisy = [
        OPTIONS.fit(where, torch.randn(400, 2, generator=torch.Generator().manual_seed(k)).double(), box=BOX)
        for k in range(5)
    ]
    smooth = blur_in_time(noisy, times, 1.0)[2](inner)
    assert float(smooth.square().mean()) < 0.35 * float(noisy[2](inner).square().mean())


def test_blur_leaves_out_frames_that_do_not_know_a_place():
    left, right = points_of(0) * 0.4, points_of(1)
    box = ((0.0, 0.0), (12e-3, 12e-3))
    fields = [
        OPTIONS.fit(left, torch.ones_like(left), box=box),
        OPTIONS.fit(right, torch.ones_like(right), box=box),
    ]
    blurred = blur_in_time(fields, [0.0, 0.01], 0.02)[1]
    assert torch.allclose(blurred(right), torch.ones_like(right), atol=1e-3)


def test_blur_refuses_unlike_grids_and_times():
    where = points_of(0)
    fields = [OPTIONS.fit(where, where, box=BOX), OPTIONS.fit(where, where)]
    with pytest.raises(InvalidInput, match="knot grids"):
        blur_in_time(fields, [0.0, 1.0], 0.1)
    with pytest.raises(InvalidInput, match="one time per field"):
        blur_in_time(fields, [0.0], 0.1)


def test_windows_agree_with_one_fit_over_all_times():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(6000, 3, generator=generator, dtype=torch.float64)
    points = points * torch.tensor([12e-3, 12e-3, 0.4], dtype=torch.float64)
    x, y, t = points[:, 0] * 200, points[:, 1] * 200, points[:, 2] * 20
    flow = torch.stack([torch.sin(y + t), torch.cos(x - t)], dim=1)
    options = OPTIONS.fixed(time_knots=0.02, time_curvature=1e-3)
    whole = options.fit(points, flow)(points)
    windows = fit_windows(options, points, flow, length=0.15, overlap=0.05)
    assert len(windows.fields) == 4
    assert float((windows(points) - flow).norm() / flow.norm()) < 0.02
    assert float((windows(points) - whole).norm() / whole.norm()) < 0.02
    late = points.clone()
    late[:, 2] = 1.0
    assert torch.isnan(windows(late)).all()
    with pytest.raises(InvalidInput, match="overlap"):
        fit_windows(options, points, flow, length=0.1, overlap=0.1)
