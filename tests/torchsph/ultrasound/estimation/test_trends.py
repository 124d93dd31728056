"""Trends that published trackers show: shear, slow axial flow behind a clutter filter, and the kernel's size."""

import torch
from ultrasound_cases import cube, lattice, packet

from torchsph.ultrasound.acquisition import Beams
from torchsph.ultrasound.estimation.tracking import SpeckleTracker

PLAIN = SpeckleTracker(clutter=None)


def test_shear_raises_the_error_and_takes_estimates_away():
    points, median, accepted = lattice(), [], []
    for rate in (0.0, 60.0, 250.0):
        found = PLAIN.track(packet((0.2, 0.1, 0.25), 11, gradient=((0,) * 3, (0,) * 3, (rate, 0, 0))), points)
        true = torch.tensor([0.2, 0.1, 0.25]) + torch.outer(points[:, 0].float(), torch.tensor([0, 0, rate]))
        median.append(float((found.velocity - true)[:, :2].abs().median()))
        accepted.append(float(found.accepted.float().mean()))
    assert median[0] < 0.5 * median[1] and median[1] < median[2]
    assert accepted[1] > 0.9 > 0.6 > accepted[2]


def test_the_clutter_filter_empties_slow_axial_flow():
    tracker, points, accepted = SpeckleTracker(), lattice(half=1), []
    for axial in (0.01, 0.3):
        found = tracker.track(packet((0.2, 0.1, axial), 12, clutter=40.0), points)
        accepted.append(float(found.accepted.float().mean()))
    assert accepted[0] < 0.1 and accepted[1] > 0.9


def test_larger_kernels_correlate_the_error():
    """At 1 mm: hardly for kernels of 1 mm, by more than 0.3 for those of 2.5 mm."""
    axis = torch.arange(-3, 4, dtype=torch.float64) * 1e-3
    points = torch.cartesian_prod(axis, axis) + torch.tensor([0.0, 20e-3])
    correlation = []
    for kernel in (1e-3, 2.5e-3):
        tracker, product, square = SpeckleTracker(clutter=None, kernel=kernel, lags=(1,)), 0.0, 0.0
        for seed in range(8):
            scene = packet((0.32, 0.26), 20 + seed, grid=cube(30, (0.0, 20e-3)), beams=Beams((0.0, 1.0)))
            error = (tracker.track(scene, points).velocity[:, 0] - 0.32).view(7, 7)
            error = error - error.mean()
            product, square = product + (error[:, 1:] * error[:, :-1]).mean(), square + error.square().mean()
        correlation.append(float(product / square))
    assert correlation[0] + 0.15 < correlation[1] and correlation[1] > 0.3
