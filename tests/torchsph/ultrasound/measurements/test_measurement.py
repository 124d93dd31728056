"""From a recording through simulated echoes to a measurement; and weights that know what they do not know."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion
from ultrasound_cases import recording

import geometry
from torchsph.methods.measurement.unwrapping import unwrapped
from torchsph.ultrasound.estimation.estimates import Estimates
from torchsph.ultrasound.estimation.tracking import SpeckleTracker
from torchsph.ultrasound.measurements.calibration import fit_calibration
from torchsph.ultrasound.measurements.doppler import DopplerOptions, measure_doppler
from torchsph.ultrasound.measurements.scanning import ScannerOptions, image_grid
from torchsph.ultrasound.measurements.speckle import SpeckleOptions, measure_speckle
from torchsph.ultrasound.measurements.training import (
    TrainingPlan,
    calibrate,
    random_scene,
    random_swirl,
    training_points,
)
from torchsph.ultrasound.scanner.echoes import EchoModel, simulate_packet

QUICK = SpeckleOptions(every=2, training=2, tissue=20.0, image_spacing=0.25e-3)


def jet(x, y, z):
    return 0.1 + 0 * x, -0.05 + 0 * x, 0.2 + 20 * x


def small(frames=3):
    return recording(jet, frames=frames, shape=(12, 10, 11))


def interior(measured):
    """Nodes (T, *shape) with a weight, two nodes or more from the wall, where kernels see blood alone."""
    structure = np.ones((1, 5, 5, 5), bool)
    return binary_erosion(measured.mask, structure) & (measured.weight > 0)


def estimates(count, generator, variance):
    """Made-up estimates whose predicted variance is ``variance`` (n,)."""
    one = torch.ones(count)
    return Estimates(
        torch.zeros((count, 3)),
        0.9 * one,
        2 * one,
        torch.ones((count, 3)),
        variance[:, None].expand(-1, 3),
        0 * one,
        20 * one,
        0 * one,
        10 * one,
        0.01 * one,
        torch.ones(count, dtype=torch.long),
        torch.zeros(count, dtype=torch.int32),
    )


def test_calibration_finds_the_law_that_made_the_errors():
    generator = torch.Generator().manual_seed(0)
    variance = torch.exp(torch.rand(6000, generator=generator) * 6 - 10)
    found = estimates(6000, generator, variance)
    true = torch.stack([3 * variance.sqrt(), 3 * variance.sqrt(), 0.5 * variance.sqrt()], 1)
    error = true * torch.randn((6000, 3), generator=generator)
    beam = torch.tensor([[0.0, 0.0, 1.0]]).expand(6000, 3)
    model = fit_calibration(found, error, beam)
    assert model.lateral.coefficients[1] == pytest.approx(1, abs=0.05)
    inner = (variance > variance.quantile(0.05)) & (variance < variance.quantile(0.95))
    torch.testing.assert_close(model.sigma(found, beam)[inner], true[inner], rtol=0.12, atol=0)
    weight = model.weight(found, beam)
    assert ((weight > 0) & (weight < 1)).all()
    assert (weight[inner][variance[inner].argsort()].diff() <= 1e-6).all()  # falls with the deviation


def test_a_tracker_that_tells_its_correlation_alone_is_calibrated_by_it():
    generator = torch.Generator().manual_seed(6)
    unknown = torch.full((4000,), torch.nan)
    found = estimates(4000, generator, unknown)
    correlation = 0.5 + 0.49 * torch.rand(4000, generator=generator)
    names = ("peak_ratio", "power", "snr", "response", "shear", "bend")
    found = dataclasses.replace(found, correlation=correlation, **dict.fromkeys(names, unknown))
    true = (1 - correlation)[:, None].expand(-1, 3)
    beam = torch.tensor([[0.0, 0.0, 1.0]]).expand(4000, 3)
    model = fit_calibration(found, true * torch.randn((4000, 3), generator=generator), beam)
    inner = (correlation > 0.55) & (correlation < 0.95)
    torch.testing.assert_close(model.sigma(found, beam)[inner], true[inner], rtol=0.25, atol=0)


def test_weight_is_zero_where_an_estimate_is_flagged():
    generator = torch.Generator().manual_seed(1)
    found = estimates(200, generator, torch.full((200,), 1e-4))
    found = dataclasses.replace(found, flags=(torch.arange(200) % 2).to(torch.int32))
    beam = torch.tensor([[0.0, 0.0, 1.0]]).expand(200, 3)
    model = fit_calibration(found, 0.05 * torch.randn((200, 3), generator=generator), beam)
    np.testing.assert_array_equal((model.weight(found, beam) == 0).numpy(), (found.flags != 0).numpy())


def test_too_few_estimates_are_refused():
    generator = torch.Generator().manual_seed(2)
    with pytest.raises(ValueError, match="50 accepted"):
        fit_calibration(estimates(20, generator, torch.ones(20)), torch.ones((20, 3)), torch.ones((20, 3)))


def test_swirls_have_no_divergence_and_the_stated_speed():
    generator = torch.Generator().manual_seed(3)
    swirl = random_swirl((0.0, 0.0, 0.0), 5e-3, 0.3, generator)
    points = torch.rand((200, 3), generator=generator, dtype=torch.float64) * 4e-3 - 2e-3
    at = [torch.autograd.functional.jacobian(lambda p: swirl.velocity(p[None], 0.0)[0], p) for p in points[:20]]
    jacobian = torch.stack(at)
    assert jacobian.diagonal(dim1=1, dim2=2).sum(1).abs().max() < 1e-9 * jacobian.abs().max()
    speeds = [
        random_swirl((0.0,) * 3, 5e-3, 0.3, generator).velocity(points, 0.0).square().sum(1).mean() for _ in range(60)
    ]
    assert float(torch.stack(speeds).mean().sqrt()) == pytest.approx(0.3, rel=0.15)


def test_image_grid_holds_the_points_as_nodes():
    true = small()
    points = true.grid.nodes()[torch.from_numpy(true.mask[0].reshape(-1))]
    grid = image_grid(true.grid, points, QUICK.spacing(true.grid), 1.2e-3)
    place = grid.locate(points)
    torch.testing.assert_close(place, place.round(), atol=1e-6, rtol=0)
    assert bool(grid.contains(points, margin=-1.2e-3).all())
    assert QUICK.spacing(true.grid) == pytest.approx((0.25e-3,) * 3)


def test_speckle_measurement_of_a_recording(tmp_path):
    true = small()
    measured = measure_speckle(true, QUICK, 0)
    np.testing.assert_array_equal(measured.time, true.time[::2])
    np.testing.assert_array_equal(measured.mask, true.mask[::2])
    seen = measured.mask & (measured.weight > 0)
    inner = interior(measured)
    # beside the wall what is left of its echoes takes many estimates away, inside hardly any
    assert seen.sum() > 0.4 * measured.mask.sum()
    assert inner.sum() > 0.9 * binary_erosion(measured.mask, np.ones((1, 5, 5, 5), bool)).sum()
    error = (measured.velocity - true.velocity[::2]).transpose(1, 0, 2, 3, 4)[:, inner]
    assert np.median(np.abs(error), axis=1)[2] < 0.03 and np.median(np.abs(error), axis=1)[:2].max() < 0.15
    deviation = measured.sigma.transpose(1, 0, 2, 3, 4)[:, inner]
    assert (deviation > 0).all() and 0.3 < (error / deviation).std() < 3
    assert not measured.velocity.transpose(0, 2, 3, 4, 1)[~seen].any()
    geometry.write_recording(tmp_path / "m.h5", measured)
    np.testing.assert_array_equal(geometry.read_recording(tmp_path / "m.h5").weight, measured.weight)
    assert "SNR 20 dB" in measured.description


def test_doppler_measurements_of_a_recording(tmp_path):
    true = small(2)
    options = DopplerOptions(every=2, tissue=20.0, image_spacing=0.25e-3)
    colour = measure_doppler(true, options, 0)
    seen = interior(colour)[0]
    assert colour.beam is not None and not colour.velocity[0, :2].any()
    error = (colour.velocity - true.velocity[::2])[0, 2][seen]
    assert seen.sum() > 50 and np.median(np.abs(error)) < 0.03
    np.testing.assert_array_equal(measure_doppler(true, options, 0).velocity, colour.velocity)
    geometry.write_recording(tmp_path / "d.h5", colour)
    assert geometry.read_recording(tmp_path / "d.h5").beam is not None
    vector = measure_doppler(true, dataclasses.replace(options, steering=25.0), 0)
    seen = interior(vector)[0]
    error = (vector.velocity - true.velocity[::2])[0][:, seen]
    assert vector.beam is None and np.median(np.abs(error), axis=1).max() < 0.08


def plane():
    """Blood turning in an ellipse, two frames of a plane recording."""
    surface = geometry.ellipse((7e-3, 9e-3), 1e-3, (0.0, 30e-3))
    grid = geometry.Grid((-8e-3, 20e-3), (1e-3, 1e-3), (21, 17))
    x, y = grid.nodes().numpy().T.reshape(2, *grid.shape)
    mask = (x / 7e-3) ** 2 + ((y - 30e-3) / 9e-3) ** 2 < 0.9
    velocity = np.stack([0.15 - 30 * (y - 30e-3), 0.2 + 30 * x]) * mask
    wall = geometry.Wall(surface.vertices, surface.faces, surface.region)
    return geometry.Recording(
        time=np.array([0.0, 0.01]),
        grid=grid,
        velocity=np.stack([velocity] * 2).astype(np.float32),
        mask=np.stack([mask] * 2),
        wall=wall,
        rho=1060.0,
        mu=4e-3,
    )


@pytest.mark.slow
def test_a_plane_is_measured_along_parallel_beams_and_in_a_sector(tmp_path):
    true, options = plane(), SpeckleOptions(training=4, every=2)
    sector = dataclasses.replace(options, apex=(0.0, 0.0), depth=30e-3)
    for chosen in (options, sector):
        measured = measure_speckle(true, chosen, 0)
        inner = measured.mask & (measured.weight > 0) & binary_erosion(measured.mask, np.ones((1, 5, 5), bool))
        error = (measured.velocity - true.velocity[:1]).transpose(1, 0, 2, 3)[:, inner]
        assert inner.sum() > 25 and np.median(np.abs(error), axis=1)[1] < 0.03
        assert np.median(np.abs(error), axis=1)[0] < 0.15
        geometry.write_recording(tmp_path / "plane.h5", measured)
        assert geometry.read_recording(tmp_path / "plane.h5").dimension == 2
    doppler = DopplerOptions(apex=(0.0, 0.0), depth=30e-3, every=2)
    found = measure_doppler(true, doppler, 0)
    beam = found.beam.reshape(2, -1).T
    away = true.grid.nodes().numpy()
    np.testing.assert_allclose(beam, away / np.linalg.norm(away, axis=1)[:, None], atol=1e-6)
    seen = found.mask & (found.weight > 0) & binary_erosion(found.mask, np.ones((1, 5, 5), bool))
    along = (true.velocity[:1] * found.beam).sum(1)
    assert np.median(np.abs((found.velocity * found.beam).sum(1) - along)[seen]) < 0.03
    np.testing.assert_allclose(found.nyquist, 0.308)


def test_echoes_of_blood_beyond_the_limit_wrap_and_come_back():
    true = plane()
    slow = DopplerOptions(apex=(0.0, 0.0), depth=30e-3, every=2, prf=3e3, clutter_filter="none", tissue=0.0)
    found = measure_doppler(true, slow, 0)
    assert found.nyquist == pytest.approx(1540 * 3e3 / (4 * 5e6))
    seen = found.mask & (found.weight > 0) & binary_erosion(found.mask, np.ones((1, 5, 5), bool))
    along = (true.velocity[:1] * found.beam).sum(1)
    before, after = (np.abs((one.velocity * found.beam).sum(1) - along)[seen] for one in (found, unwrapped(found)))
    assert (before > found.nyquist[0]).mean() > 0.3 and (after > found.nyquist[0]).mean() < 0.01
    assert np.median(after) < 0.03


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"every": 0}, "every"),
        ({"image_spacing": 0.0}, "image_spacing"),
        ({"clutter_filter": "magic"}, "clutter_filter"),
        ({"snr": float("nan")}, "snr"),
        ({"packet": 4}, "9 taps"),
        ({"prf": -1.0}, "prf"),
        ({"beam": (0.0, 0.0)}, "direction"),
        ({"apex": (0.0, 0.0), "beam": (0.0, 0.0, 1.0)}, "dimension"),
    ],
)
def test_bad_scanner_options_are_refused_by_name(options, message):
    with pytest.raises(ValueError, match=message):
        ScannerOptions(**options)


def test_a_beam_of_another_dimension_is_refused():
    with pytest.raises(ValueError, match="beam has 2"):
        measure_speckle(small(), dataclasses.replace(QUICK, beam=(0.0, 1.0)), 0)


@pytest.mark.slow
def test_deviations_hold_in_each_third_of_the_weight_on_held_out_simulations():
    """z-scores have deviations of 0.8 to 1.25 in every third of the weight: each component, and all together."""
    model, spacing, plan = EchoModel(), (1e-3 / 6,) * 3, TrainingPlan()
    tracker = SpeckleTracker(max_snr=26.0)
    calibration = calibrate(model, tracker, spacing, torch.Generator().manual_seed(0), plan)
    lattice = training_points(plan, (0.0,) * 3)
    grid = geometry.Grid((-33 * spacing[0],) * 3, spacing, (67,) * 3)
    scores, weights = [], []
    for seed, speed in enumerate((0.08, 0.12, 0.18, 0.25, 0.33, 0.4) * 4, 100):
        generator = torch.Generator().manual_seed(seed)
        flow = random_scene((0.0,) * 3, plan.half, speed, generator, tissue_speed=plan.tissue_speed)
        points = lattice[flow.blood(lattice, 0.0)]
        found = tracker.track(simulate_packet(flow, grid, model, 0.0, generator), points)
        beam = model.beams.directions(points).float()
        score = (found.velocity - flow.velocity(points, 0.0)) / calibration.sigma(found, beam)
        scores.append(score[found.accepted])
        weights.append(calibration.weight(found, beam)[found.accepted])
    score, weight = torch.cat(scores), torch.cat(weights)
    thirds = weight.argsort().tensor_split(3)
    # rows: thirds; columns: x, y, z and all together
    square = torch.stack([score[third].square().mean(0) for third in thirds])
    spread = torch.cat([square, square.mean(1, keepdim=True)], 1).sqrt()
    assert (spread > 0.8).all() and (spread < 1.25).all(), spread
