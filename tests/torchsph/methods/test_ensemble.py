"""The ensemble cycle and what it rests on: perturbations, the error model, determinism, a gain over the raw data."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import torch

import geometry
from geometry.grids.fields import fwhm_to_deviation, smooth_noise
from regularize import Smoother
from torchsph import EnsembleOptions, PreparedMeasurement, Simulator, assimilate, estimate_error, filter_sph, preset
from torchsph.data import sample_measurement, sample_truth
from torchsph.methods.ensemble.model_error import flow_perturbations
from torchsph.methods.measurement.error_model import kernel_width
from torchsph.methods.measurement.frame_splines import FrameSmoother, node_weights, smooth_frames
from torchsph.methods.measurement.wall_rows import open_regions, wall_rows
from torchsph.simulator.scene import Scene


@pytest.fixture(scope="module")
def measured():
    return geometry.read_recording(sample_measurement()).select(slice(9, 12))


@pytest.fixture(scope="module")
def truth(measured):
    every = geometry.read_recording(sample_truth())
    return every.velocity[[int(np.abs(every.time - t).argmin()) for t in measured.time]]


@pytest.fixture(scope="module")
def prepared(measured):
    return PreparedMeasurement(measured)


@pytest.fixture(scope="module")
def splines(prepared):
    return prepared.splines


@pytest.fixture(scope="module")
def smoothed(prepared):
    return prepared.smoothed


@pytest.fixture(scope="module")
def model(measured):
    return Simulator(Scene.from_recording(measured, 3e-3), preset("default"))


def nrmse(field, truth, mask):
    inside = np.moveaxis(field - truth, 1, -1)[mask]
    return float(np.sqrt(np.square(inside).sum() / np.square(np.moveaxis(truth, 1, -1)[mask]).sum()))


def test_perturbations_have_their_size_no_divergence_and_no_flow_through_walls():
    axis = np.arange(24) - 11.5
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    mask = x**2 + y**2 + z**2 < 100
    fields = flow_perturbations(4, mask, (1e-3,) * 3, 0.05, 2e-3, torch.Generator().manual_seed(0))
    assert float(fields[:, :, torch.from_numpy(mask)].square().mean().sqrt()) == pytest.approx(0.05)
    assert fields.mean(0).abs().max() < 1e-12
    assert not fields[:, :, torch.from_numpy(~mask)].any()
    inner = torch.from_numpy(x**2 + y**2 + z**2 < 49)
    slopes = [torch.gradient(fields[:, 2 - a], spacing=1e-3, dim=a + 1)[0] for a in range(3)]
    divergence = sum(slopes)[:, inner].square().mean().sqrt()
    assert divergence < 1e-6 * slopes[0][:, inner].square().mean().sqrt()
    radius = np.sqrt(x**2 + y**2 + z**2)
    edge = torch.from_numpy((radius > 8.7) & mask)
    normal = torch.from_numpy(np.stack([x, y, z]) / radius)
    through = (fields * normal).sum(1)[:, edge].square().mean().sqrt()
    assert through < 0.35 * fields[:, :, edge].square().sum(1).mean().sqrt()


def test_perturbations_follow_the_seed():
    mask = np.ones((8, 8), bool)
    draw = [flow_perturbations(2, mask, (1.0, 1.0), 1.0, 2.0, torch.Generator().manual_seed(s)) for s in (1, 1, 2)]
    assert torch.equal(draw[0], draw[1])
    assert not torch.equal(draw[0], draw[2])


def test_wall_rows_carry_the_flux_of_the_open_valve(measured):
    """Normal velocity summed over all faces equals zero: what the walls sweep, the open valve lets in."""
    motion = geometry.WallMotion.from_recording(measured)
    rows = wall_rows(measured, motion, 1)
    through = (rows.normals * rows.velocity).sum(1) * rows.weight
    assert abs(float(through.sum())) < 1e-9 * float(through.abs().sum())
    regions = open_regions(measured, float(measured.time[1]))
    assert regions == (1,)
    assert not rows.no_slip.all()
    assert float(wall_rows(measured, motion, 1, at_rest=True).velocity.abs().max()) == 0.0


def test_openings_that_are_open_together_have_no_rows_and_the_shut_wall_keeps_all(measured):
    """How they share dV/dt is for the data to say."""
    both = dataclasses.replace(measured, valve_intervals=np.array([[1.0, -1.0, 9.0], [2.0, -1.0, 9.0]]))
    motion = geometry.WallMotion.from_recording(both)
    rows = wall_rows(both, motion, 1)
    assert open_regions(both, float(both.time[1])) == (1, 2)
    surface = motion.surface(float(both.time[1]))
    assert bool(rows.no_slip.all()) and float(rows.weight.sum()) == pytest.approx(
        float(surface.areas[surface.region == 0].sum())
    )


def test_error_model_finds_white_noise(measured, smoothed):
    """Noise of a known size on a smooth field comes back within 15 %, with no redundancy, weights as confidences."""
    generator = np.random.default_rng(0)
    noise = 0.05 * generator.standard_normal(measured.velocity.shape)
    made = measured.with_velocity((smoothed.velocity + noise * measured.mask[:, None]).astype(np.float32))
    splines = FrameSmoother(made, Smoother())
    error = estimate_error(made, splines, smooth_frames(splines))
    np.testing.assert_allclose(error.deviation, 0.05, rtol=0.15)
    assert error.redundancy.max() < 2.5
    variance = error.variance(made, 0)
    assert np.isinf(variance[:, ~made.mask[0]]).all()
    assert np.median(variance[:, made.mask[0]]) == pytest.approx(0.05**2, rel=0.3)


def test_missing_velocities_have_no_weight(measured):
    velocity = measured.velocity.copy()
    k, j, i = np.argwhere(measured.mask[0])[0]
    velocity[0, 1, k, j, i] = np.nan
    weights = node_weights(measured.with_velocity(velocity), 0)
    assert weights[k, j, i] == 0
    assert weights[measured.mask[0]].sum() == measured.mask[0].sum() - 1


def test_ensemble_and_nudging_stay_well_below_raw(measured, truth, model, prepared):
    raw = nrmse(np.nan_to_num(measured.velocity), truth, measured.mask)
    run = assimilate(prepared, model, members=4, seed=1)
    geometry.check_recording(run.recording, "ensemble")
    assert nrmse(run.recording.velocity, truth, measured.mask) < 0.5 * raw
    assert run.recording.sigma is not None
    inside = np.moveaxis(run.recording.sigma, 1, -1)[measured.mask]
    assert (inside > 0).mean() > 0.99
    again = assimilate(prepared, model, members=4, seed=1)
    np.testing.assert_array_equal(again.recording.velocity, run.recording.velocity)
    particles = filter_sph(prepared, model, seed=1)
    geometry.check_recording(particles.recording, "sph")
    assert nrmse(particles.recording.velocity, truth, measured.mask) < 0.8 * raw


@pytest.mark.parametrize("width", [2.5e-3, 4e-3])
def test_the_kernel_shows_in_the_colour_of_the_noise(width):
    """White noise averaged by a Gaussian of known width, stronger on one side, outliers on top."""
    spacing, shape = (1e-3, 1e-3, 1e-3), (24, 24, 24)
    noise = smooth_noise(6, shape, fwhm_to_deviation(width), spacing, torch.Generator().manual_seed(0))
    noise = noise.reshape(2, 3, *shape).double().numpy() * np.linspace(0.5, 1.5, shape[2])
    used = np.ones((2, *shape), bool)
    draw = np.random.default_rng(0)
    noise[draw.random(noise.shape) < 0.02] = 5.0
    assert kernel_width(noise, used, spacing) == pytest.approx(width, rel=0.08)
    assert kernel_width(draw.standard_normal(noise.shape), used, spacing) == 0.0


def test_the_kernel_is_found_behind_splines_that_follow_the_noise(measured, smoothed):
    """Noise of a known kernel on a smooth field: what splines leave of it looks narrower; they are seen through."""
    spacing, width = tuple(measured.grid.spacing), 2.8 * min(measured.grid.spacing)
    draw = torch.Generator().manual_seed(0)
    noise = smooth_noise(
        3 * measured.frames, measured.grid.shape, fwhm_to_deviation(width), spacing, draw, dtype=torch.float64
    )
    noise = 0.06 * noise.reshape(measured.velocity.shape).numpy()
    made = measured.with_velocity((smoothed.velocity + noise * measured.mask[:, None]).astype(np.float32))
    splines = FrameSmoother(made, Smoother())
    fields = smooth_frames(splines)
    used = np.stack([node_weights(made, frame) > 0 for frame in range(made.frames)])
    left = kernel_width((made.velocity - fields.velocity).astype(np.float64), used, spacing)
    found = estimate_error(made, splines, fields).kernel
    assert left < 0.95 * width
    assert found == pytest.approx(width, rel=0.08)


@pytest.mark.parametrize("trust", [-1.0, 0.0, 1.0])
def test_the_weight_counts_for_what_it_is_worth(measured, smoothed, splines, trust):
    draw = np.random.default_rng(1)
    weight = np.where(measured.mask, draw.uniform(0.2, 1.0, measured.mask.shape), 0.0)
    spread = 0.05 * np.where(weight > 0, weight, 1.0) ** (-0.5 * trust)
    noisy = smoothed.velocity + spread[:, None] * draw.standard_normal(measured.velocity.shape)
    made = replace(measured, velocity=noisy.astype(np.float32) * measured.mask[:, None], weight=weight)
    assert estimate_error(made, splines, smoothed).trust == pytest.approx(trust, abs=0.15)


def test_a_recording_with_sigma_is_believed(measured, model, splines, smoothed):
    sigma = np.full_like(measured.velocity, 0.04)
    told = geometry.Recording(**{**measured.__dict__, "sigma": sigma})
    error = estimate_error(told, splines, smoothed)
    assert error.deviation is None
    inside = error.variance(told, 0)[:, told.mask[0]]
    assert inside.min() == pytest.approx(0.04**2)


def test_bad_ensembles_are_refused(measured, model):
    with pytest.raises(ValueError, match="at least 2 members, got 1"):
        assimilate(measured, model, members=1)
    with pytest.raises(ValueError, match="resume needs"):
        assimilate(measured, model, resume=True)
    for wrong in ({"memory": 0.0}, {"model_error": 1.5}, {"length": 0.0}, {"increments": ("magic",)}, {"kernel": -1.0}):
        with pytest.raises(ValueError, match=f"EnsembleOptions.{next(iter(wrong))}"):
            EnsembleOptions(**wrong)
