"""Measurements that wrap: phantom cuts, what a forecast decides, and that a known limit changes nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from paths import SHARED_DATA

import geometry
from geometry import Quality, Recording
from torchsph import EnsembleOptions, PreparedMeasurement, assimilate, make_model, smooth
from torchsph.assimilation import Observations, Reason
from torchsph.methods.measurement.unwrapping import nearest_branch, unwrapped
from torchsph.ultrasound import NoiseModel, aliased, measure_noise

LIMIT = 0.05  # m/s, half of the fastest vortex
SIZE = 0.02  # m


def cells(points: np.ndarray, time: float) -> np.ndarray:
    """Steady vortices in a box, without divergence and tangential at its sides, m/s."""
    x, y = (np.pi * points / SIZE).T
    return 0.1 * np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y)], 1)


@pytest.fixture(name="clean")
def _clean(box_recording: Callable[..., Recording]) -> Recording:
    clean = box_recording(cells, dimension=2, size=SIZE, nodes=12, times=(0.0, 0.005))
    noise = np.random.default_rng(0).normal(0, 0.004, clean.velocity.shape) * clean.mask[:, None]
    return replace(clean, velocity=clean.velocity + noise.astype(np.float32), weight=clean.mask.astype(np.float32))


def along_last(recording: Recording) -> Recording:
    """The component along the last axis alone."""
    beam = np.zeros(recording.velocity.shape[1:], np.float32)
    beam[-1] = 1
    return replace(recording, velocity=np.nan_to_num(recording.velocity) * beam, beam=beam)


def plane_of(recording: Recording, row: int) -> Recording:
    """The plane of nodes y = row of a volume, without walls, its beam along z."""
    grid = recording.grid
    flat = geometry.Grid(grid.origin[::2], grid.spacing[::2], grid.shape[::2])
    velocity, mask = recording.velocity[:, ::2, :, row], recording.mask[:, :, row]
    weight = None if recording.weight is None else recording.weight[:, :, row]
    plane = Recording(recording.time, flat, velocity, mask, None, recording.rho, recording.mu, weight=weight)
    return along_last(plane)


@pytest.mark.parametrize("seen", ["vectors", "beam"])
def test_what_has_wrapped_comes_back_as_it_was(clean: Recording, seen: str) -> None:
    whole = clean if seen == "vectors" else along_last(clean)
    wrapped = aliased(whole, LIMIT)
    assert np.abs(wrapped.velocity).max() < 1.001 * LIMIT < np.abs(whole.velocity).max()
    wrapped.check()
    np.testing.assert_allclose(unwrapped(wrapped).velocity, whole.velocity, atol=1e-7)
    slow = aliased(whole, 1.0)
    np.testing.assert_array_equal(unwrapped(slow).velocity, whole.velocity)
    assert unwrapped(whole) is whole


def test_a_beam_of_any_direction(clean: Recording) -> None:
    angle = np.linspace(0.2, 1.2, clean.grid.size).reshape(clean.grid.shape)
    beam = np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32)
    along = replace(clean, velocity=(clean.velocity * beam).sum(1, keepdims=True) * beam, beam=beam)
    wrapped = aliased(along, LIMIT)
    assert (np.abs(wrapped.velocity - along.velocity) > LIMIT).any()
    np.testing.assert_allclose(unwrapped(wrapped).velocity, along.velocity, atol=1e-7)


def test_each_component_has_its_own_limit(clean: Recording) -> None:
    limits = np.array([0.05, 0.08])
    velocity = clean.velocity - 2 * limits[:, None, None] * np.rint(clean.velocity / (2 * limits[:, None, None]))
    known = replace(clean, velocity=velocity, nyquist=np.tile(limits, (2, 1)))
    np.testing.assert_allclose(unwrapped(known).velocity, clean.velocity, atol=1e-7)


@pytest.mark.phantom("lv_phantom_a.h5", "lv_phantom_a_measured.h5", "lv_phantom_a_noisy.h5")
@pytest.mark.parametrize("noise", ["measured", "noisy"])
def test_cuts_of_the_phantom_keep_less_than_one_per_cent(noise: str) -> None:
    """The fastest blood moves at 2.1 times the limit; hops to false peaks are no speeds that wrapped."""
    measured = geometry.read_recording(SHARED_DATA / f"lv_phantom_a_{noise}.h5").select(slice(None, None, 3))
    true = geometry.read_recording(SHARED_DATA / "lv_phantom_a.h5").select(slice(None, None, 6))
    limit = float(np.abs(true.velocity[:, 2]).max()) / 2.1
    for row in (9, 10):
        seen, right = plane_of(measured, row), plane_of(true, row)
        held = seen.mask & (seen.weight > 0) & (np.abs(seen.velocity - right.velocity).max(1) < 0.35)
        wrapped = aliased(seen, limit)
        before, after = (
            (np.abs(one.velocity - seen.velocity).max(1) > limit)[held].mean() for one in (wrapped, unwrapped(wrapped))
        )
        assert before > 0.015 and after < 0.001


def test_the_splines_of_a_wrapped_measurement_are_those_of_the_whole_one(clean: Recording) -> None:
    whole, wrapped = smooth(clean), smooth(aliased(clean, LIMIT))
    np.testing.assert_allclose(wrapped.velocity, whole.velocity, atol=1e-5)
    assert wrapped.nyquist is None


def test_a_forecast_tells_the_branch_where_its_spread_is_small() -> None:
    generator = torch.Generator().manual_seed(0)
    right = torch.linspace(-0.9, 0.9, 400, dtype=torch.float64)
    spread = torch.where(torch.arange(400) < 200, 0.05, 0.6)
    predicted = right + spread * torch.randn((40, 400), generator=generator, dtype=torch.float64)
    wrapped = right - 0.8 * (right / 0.8).round()
    observations = Observations(wrapped, torch.full((400,), 0.03**2))
    found = nearest_branch(observations, predicted, torch.full((400,), 0.4, dtype=torch.float64))
    code = found.codes()
    assert bool((code[:200] == 0).all()) and torch.allclose(found.value[:200], right[:200])
    doubtful = code == Reason.AMBIGUOUS
    assert int(doubtful[200:].sum()) > 50
    kept = ~doubtful[200:]
    assert torch.equal(found.value[200:][kept], wrapped[200:][kept])  # neighbours' branches stand
    free = nearest_branch(observations, predicted, torch.full((400,), torch.inf, dtype=torch.float64))
    assert torch.equal(free.value, wrapped) and not bool(free.codes().any())


def test_the_doubt_is_that_of_two_gaussians() -> None:
    """The next branch's likelihood over the nearest one's, from two densities written out."""
    members = torch.tensor([[0.28], [0.32]], dtype=torch.float64)  # mean .3, variance 8e-4
    density = torch.distributions.Normal(0.3, float((8e-4 + 0.01) ** 0.5))
    for value in (-0.31, -0.35, -0.4, -0.5):
        both = torch.tensor([value, value + 0.8], dtype=torch.float64)
        chance = density.log_prob(both).exp()
        found = nearest_branch(
            Observations(both[:1], torch.tensor([0.01])), members, torch.tensor([0.4], dtype=torch.float64)
        )
        doubt = float(chance[0] / chance[1]) > 0.05
        assert bool(found.codes()[0] == Reason.AMBIGUOUS) == doubt
        assert float(found.value[0]) == pytest.approx(value + 0.8)


def analysed(recording: Recording) -> Recording:
    model = make_model(recording, spacing=2e-3)
    options = EnsembleOptions(increments=("ensemble",), batch=4, gross_error=None)
    return assimilate(PreparedMeasurement(recording), model, members=4, options=options).recording


def test_the_ensemble_is_told_the_same_by_a_wrapped_measurement(clean: Recording) -> None:
    whole, wrapped = analysed(along_last(clean)), analysed(aliased(along_last(clean), LIMIT))
    np.testing.assert_allclose(wrapped.velocity, whole.velocity, atol=1e-4)


def test_nodes_whose_branch_the_forecast_cannot_tell_say_so(clean: Recording) -> None:
    """A node without neighbours that has wrapped: only a forecast knows, and one that is vague cannot."""
    weight = clean.weight.copy()
    weight[1] = 0
    weight[1, 6, 2] = 1
    alone = along_last(replace(clean, weight=weight))
    wrapped = aliased(alone, LIMIT)
    assert abs(alone.velocity[1, 1, 6, 2]) > LIMIT
    assert unwrapped(wrapped).velocity[1, 1, 6, 2] == wrapped.velocity[1, 1, 6, 2]
    assert analysed(wrapped).quality[1, 6, 2] == Quality.USED
    unsure = replace(alone, sigma=np.full(clean.velocity.shape, LIMIT, np.float32))
    assert analysed(aliased(unsure, LIMIT)).quality[1, 6, 2] == Quality.AMBIGUOUS


def test_the_noise_model_wraps_and_reports_the_beam_alone(clean: Recording) -> None:
    plain = replace(clean, weight=None)
    options = NoiseModel(outliers=0, dropout=0, clutter=None)
    vectors = measure_noise(plain, options, 0)
    beam = measure_noise(plain, replace(options, beam_only=True), 0)
    np.testing.assert_array_equal(beam.velocity[:, 1], vectors.velocity[:, 1])
    assert beam.nyquist is None and not beam.velocity[:, 0].any()
    wrapped = measure_noise(plain, replace(options, beam_only=True, nyquist=LIMIT), 0)
    turns = (beam.velocity[:, 1] - wrapped.velocity[:, 1]) / (2 * LIMIT)
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-5)
    assert np.abs(turns).max() > 0.5 and wrapped.nyquist.tolist() == [LIMIT, LIMIT]
    with pytest.raises(ValueError, match="nyquist must be positive"):
        NoiseModel(nyquist=0.0)
    with pytest.raises(ValueError, match="limit must be positive"):
        aliased(beam, -1.0)
