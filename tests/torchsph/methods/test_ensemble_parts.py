"""The parts of the ensemble's cycle: what is learned from innovations, what a measurement sees, who runs what."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import geometry
from regularize import Smoother
from torchsph.assimilation import ETKF, AssimilationError, LearnedGain, Observations, Reason, SpreadMatch
from torchsph.data import sample_measurement
from torchsph.evaluation.divergence import divergence_rms
from torchsph.evaluation.metrics import spread_over_skill
from torchsph.methods.ensemble.divergence_cleaning import without_divergence
from torchsph.methods.ensemble.lagged import LaggedAnalyses
from torchsph.methods.measurement.error_model import ObservationError
from torchsph.methods.measurement.frame_splines import FrameSmoother
from torchsph.methods.measurement.observation_operator import Measurement
from torchsph.methods.measurement.prepared import PreparedMeasurement
from torchsph.methods.measurement.regions import flow_regions


@pytest.fixture(scope="module")
def measured():
    return geometry.read_recording(sample_measurement()).select(slice(10, 12))


def run_scalar(noise: float, forcing: float, decay: float, cycles: int, seed: int) -> tuple[LearnedGain, float]:
    """Many independent scalar systems, x' = decay x + w, y = x + v, whose filter follows the learned gain."""
    size, draw = 4000, torch.Generator().manual_seed(seed)

    def white() -> torch.Tensor:
        return torch.randn(size, generator=draw, dtype=torch.float64)

    gain = LearnedGain(1, memory=20.0)
    truth, guess, offered, weight = white(), torch.zeros(size, dtype=torch.float64), None, torch.ones(size)
    for _ in range(cycles):
        truth, guess = decay * truth + forcing * white(), decay * guess
        innovation = truth + noise * white() - guess
        if offered is not None:
            gain.learn(offered, innovation, weight)
        guess, offered = guess + float(gain.weight) * innovation, innovation[None]
    prior = 1.0
    for _ in range(200):  # the Riccati equation of the same system: what the Kalman filter's gain becomes
        posterior = prior * noise**2 / (prior + noise**2)
        prior = decay**2 * posterior + forcing**2
    return gain, prior / (prior + noise**2)


@pytest.mark.parametrize("noise,forcing", [(0.3, 0.3), (1.0, 0.3), (0.2, 0.6)])
def test_the_learned_gain_becomes_the_kalman_gain(noise, forcing):
    gain, kalman = run_scalar(noise, forcing, 0.98, 150, 0)
    assert float(gain.weight) == pytest.approx(kalman, abs=0.04)


def test_a_useless_increment_is_ignored_and_a_checkpoint_goes_on():
    draw = torch.Generator().manual_seed(0)
    gain, other = LearnedGain(2, 1, memory=15.0), LearnedGain(2, 1, memory=15.0)
    for cycle in range(80):
        error, junk = torch.randn(2, 2000, generator=draw, dtype=torch.float64)
        offered = torch.stack([error, junk])
        left = error - gain.weight @ offered + 0.3 * torch.randn(2000, generator=draw, dtype=torch.float64)
        gain.learn(offered, left, torch.ones(2000))
        if cycle == 40:
            other.restore(gain.state())
        elif cycle > 40:
            other.learn(offered, left, torch.ones(2000))
    assert gain.weight.tolist() == pytest.approx([1.0, 0.0], abs=0.05)
    assert torch.equal(gain.weight, other.weight)
    gain.learn(offered, left, torch.zeros(2000))  # nothing was observed: nothing is learned
    assert torch.equal(gain.weight, other.weight)
    with pytest.raises(AssimilationError, match="do not belong together"):
        gain.learn(offered, left[1:], torch.ones(2000))
    with pytest.raises(AssimilationError, match="LearnedGain needs"):
        LearnedGain(0)


def test_a_lagged_analysis_is_the_kalman_smoother_of_a_linear_model():
    """Random walk of two numbers: the state before the last, given all data, against the closed form."""
    draw, count = torch.Generator().manual_seed(0), 500
    prior, forcing, noise = 1.0, 0.5, 0.7
    members = prior**0.5 * torch.randn(count, 2, generator=draw, dtype=torch.float64)
    later = members + forcing**0.5 * torch.randn(count, 2, generator=draw, dtype=torch.float64)
    seen = torch.tensor([1.3, -0.4], dtype=torch.float64)
    analysis = ETKF().analyse(later, later, Observations(seen, torch.full((2,), noise, dtype=torch.float64)))
    past = LaggedAnalyses(1)
    deviation = members.std(0).reshape(2, 1)
    past.add(0, members.mean(0).reshape(2, 1), members.reshape(count, 2, 1), deviation)
    (found,) = past.improved(analysis, torch.tensor([0]), 2)
    gain = prior / (prior + forcing + noise)
    np.testing.assert_allclose(found.control[:, 0], gain * seen, atol=0.15)  # 500 members know their mean to 0.05
    np.testing.assert_allclose(found.sigma[:, 0], (prior - gain * prior) ** 0.5, rtol=0.1)
    past.take([found])
    past.replaced(3, 7)
    assert torch.equal(past.kept[0].anomalies[3], past.kept[0].anomalies[7])


def run_twin(forcing: float, noise: float, stated: float, cycles: int = 60) -> list[tuple[float, float]]:
    """Spread over error of forecasts and analyses, cycle by cycle, in a twin that knows neither of its noises.

    x' = 0.95 x + w in 1500 places at once, y = x + v. The estimator sees 0.9 of each innovation, its weight is learned,
    the 20 members are forced with ``stated`` instead of ``forcing`` and start at a quarter of the error.
    """
    draw, count, size = torch.Generator().manual_seed(0), 20, 1500

    def white(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, size, generator=draw, dtype=torch.float64)

    gain, match, truth = LearnedGain(1), SpreadMatch(), white()
    guess, anomalies, offered, ratios = truth + 0.4 * white(), 0.1 * white(count), None, []
    for _ in range(cycles):
        truth, guess = 0.95 * truth + forcing * white(), 0.95 * guess
        forced = stated * white(count)
        anomalies = match.factor * (0.95 * anomalies + forced - forced.mean(0))
        before = spread_over_error(anomalies, guess, truth)
        innovation = truth + noise * white() - guess
        if offered is not None:
            gain.learn(offered, innovation, torch.ones(size))
        offered = 0.9 * innovation[None]
        change = float(gain.weight) * offered[0]
        one = torch.randn(count, generator=draw, dtype=torch.float64) @ anomalies / (count - 1) ** 0.5
        match.learn(float(change @ offered[0]), float(0.9 * one @ one))
        filtered = 0.3 * anomalies  # a transform that believes far too much
        left = match.left(*(float(a.var(0).sum()) for a in (anomalies, filtered)), float(change.square().sum()))
        guess, anomalies = guess + change, left * filtered
        ratios.append((before, spread_over_error(anomalies, guess, truth)))
    return ratios


def spread_over_error(anomalies, guess, truth) -> float:
    return float((anomalies.var(0).mean() / (guess - truth).square().mean()).sqrt())


@pytest.mark.parametrize("forcing,noise,stated", [(0.3, 0.5, 0.1), (0.3, 0.5, 0.6), (0.2, 0.8, 0.3), (0.3, 0.3, 0.2)])
def test_the_spread_becomes_that_of_the_errors(forcing, noise, stated):
    """In forecasts and analyses alike, with members that are forced by a third to twice of what they should be.

    A learned gain below the best one takes less than the error loses: analyses err by up to 0.09 on the safe side.
    """
    forecasts, analyses = (np.mean(part[30:]) for part in zip(*run_twin(forcing, noise, stated), strict=True))
    assert forecasts == pytest.approx(1.0, abs=0.1)
    assert 0.95 < analyses < 1.12


def test_a_spread_match_goes_on_from_its_state():
    match, again = SpreadMatch(), SpreadMatch()
    match.learn(3.0, 1.0)
    assert match.now == pytest.approx(3.0**0.5)  # the first cycle closes the whole gap
    assert match.left(1.0, 1.0, 0.3) == pytest.approx((3.0 - 0.3) ** 0.5)
    again.restore(match.state())
    match.learn(2.0, 1.0), again.learn(2.0, 1.0)
    assert match.left(2.0, 1.0, 0.4) == again.left(2.0, 1.0, 0.4) and match.factor == again.factor
    match.learn(1.0, 0.0)  # a collapsed ensemble tells nothing
    assert match.now == 1.0
    with pytest.raises(AssimilationError, match="SpreadMatch needs"):
        SpreadMatch(memory=0.5)


def plain_error(recording, **more) -> ObservationError:
    frames, shape = recording.frames, recording.grid.shape
    return ObservationError(np.full((frames, 3), 0.05), np.ones(frames), np.ones((frames, *shape)), **more)


def linear_field(grid: geometry.Grid) -> torch.Tensor:
    """(1, 3, *shape) with v = (1 + 20 y, 2 - 10 z, 30 x)."""
    x, y, z = (grid.nodes()[:, k].reshape(grid.shape) for k in range(3))
    return torch.stack([1 + 20 * y, 2 - 10 * z, 30 * x])[None]


def test_a_measurement_sees_its_own_nodes_its_beam_and_its_blur(measured):
    mask = torch.ones(measured.grid.shape, dtype=torch.bool)
    field = linear_field(measured.grid)
    shifted = geometry.Grid(tuple(o + 0.4e-3 for o in measured.grid.origin), (2e-3,) * 3, (14, 8, 8))
    inside = np.ones((2, *shifted.shape), bool)
    beam = np.zeros((3, *shifted.shape), np.float32)
    beam[1], beam[2] = 0.6, 0.8
    other = geometry.Recording(
        time=measured.time,
        grid=shifted,
        velocity=np.zeros((2, 3, *shifted.shape), np.float32),
        mask=inside,
        wall=measured.wall,
        rho=measured.rho,
        mu=measured.mu,
        beam=beam,
    )
    measurement = Measurement(PreparedMeasurement(other, error=plain_error(other)), measured.grid)
    seen = measurement.see(0)
    exact = linear_field(shifted)[0]
    along = (0.6 * exact[1] + 0.8 * exact[2]).flatten()
    torch.testing.assert_close(measurement.predict(field, mask, seen)[0], along, rtol=1e-5, atol=1e-6)
    assert seen.parts == 1 and measurement.type.parts == 1
    # far from the edges a Gaussian leaves a linear field as it is, and lowers a wave by exp(-k^2 s^2 / 2)
    blurred = Measurement(PreparedMeasurement(measured, error=plain_error(measured, kernel=2.5e-3)), measured.grid)
    seen = blurred.see(0)
    wave = torch.cos(2 * math.pi / 8e-3 * measured.grid.nodes()[:, 2]).reshape(measured.grid.shape)
    fields = torch.cat([field, wave.expand(1, 3, *wave.shape)])
    linear, damped = blurred.predict(fields, mask, seen).reshape(2, 3, -1)
    k, j, i = np.unravel_index(seen.node.numpy(), measured.grid.shape)
    deep = torch.from_numpy((k > 5) & (k < 27) & (j > 5) & (j < 14) & (i > 5) & (i < 14))
    exact = field.flatten(2)[0][:, seen.node][:, deep].double()
    torch.testing.assert_close(linear[:, deep], exact, rtol=1e-4, atol=1e-5)
    factor = math.exp(-0.5 * (2 * math.pi / 8e-3 * 2.5e-3 / 2.3548) ** 2)
    torch.testing.assert_close(damped[0, deep], factor * wave.flatten()[seen.node][deep].double(), rtol=2e-2, atol=2e-2)


def test_missing_values_come_with_their_reason(measured):
    velocity, weight = measured.velocity.copy(), np.array(measured.weight)
    k, j, i = np.argwhere(measured.mask[0] & (weight[0] > 0))[[3, 9]].T
    velocity[0, 0, k[0], j[0], i[0]] = np.nan
    weight[0, k[1], j[1], i[1]] = 0.0
    holed = replace(measured, velocity=velocity, weight=weight)
    seen = Measurement(PreparedMeasurement(holed, error=plain_error(holed)), holed.grid).see(0)
    flat = np.ravel_multi_index((k, j, i), measured.grid.shape)
    codes = seen.observations.codes().reshape(3, -1)
    assert (codes[:, seen.node == int(flat[0])] == Reason.MISSING).all()
    assert (codes[:, seen.node == int(flat[1])] == Reason.NO_WEIGHT).all()
    assert (seen.confidence[torch.isin(seen.node, torch.from_numpy(flat))] == 0).all()


def test_draws_have_the_deviation_that_the_posterior_states(measured):
    splines = FrameSmoother(measured, Smoother())
    fitted = splines.fit(0, uncertainty=True)
    mask = torch.from_numpy(np.array(measured.mask[0], bool))
    draws = splines.draws(fitted, 0, 40, torch.Generator().manual_seed(0))[:, :, mask]
    stated = fitted.std(splines.nodes[mask.flatten()]).T.double()
    np.testing.assert_allclose(draws.square().mean((0, 2)).sqrt(), stated.square().mean(1).sqrt(), rtol=1e-6)
    # larger where the posterior is wider: at 40 draws the deviation of each node is known to a ninth
    assert np.corrcoef(draws.std(0).flatten(), stated.flatten())[0, 1] > 0.7
    assert float(draws.mean(0).square().mean().sqrt()) < 2 * float(stated.square().mean().sqrt()) / 40**0.5


def test_removing_divergence_is_a_projection():
    """A discrete curl has no divergence by central differences and stays; a gradient goes with its divergence."""
    axis = np.linspace(-1, 1, 20)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    mask, spacing = x**2 + y**2 + z**2 < 0.8, (1e-3,) * 3
    potential = np.sin(3 * x) * np.cos(2 * y) * np.cos(z)
    turning = np.stack([np.gradient(potential, 1e-3, axis=1), -np.gradient(potential, 1e-3, axis=2), 0 * x])
    kept = without_divergence(turning, mask, spacing).velocity
    np.testing.assert_allclose(kept[:, mask], turning[:, mask], atol=1e-6 * np.abs(turning).max())
    field = turning + 40.0 * np.stack([x * y, x - y**2, z * x])
    found = without_divergence(field, mask, spacing)
    clean = found.velocity
    assert found.converged
    before, after = (divergence_rms(f[None], mask[None], spacing).value for f in (field, clean))
    assert after < 0.12 * before
    assert found.left == pytest.approx(after / before, rel=1e-3)
    assert np.abs(clean[:, ~mask]).max() == 0.0
    # of all fields without divergence it is the nearest: the change is orthogonal to what is left of it
    change, kept = (field - clean)[:, mask], turning[:, mask]
    assert abs(float((change * kept).sum())) < 1e-3 * np.linalg.norm(change) * np.linalg.norm(kept)
    # too few iterations are told; a result that is no better than nothing is not taken
    short = without_divergence(field, mask, spacing, reduction=1e-6, iterations=1)
    assert not short.converged and short.left == 1.0
    np.testing.assert_array_equal(short.velocity, field)


def test_regions_of_a_ventricle(measured):
    surface = geometry.WallMotion.from_recording(measured).surface(float(measured.time[0]))
    position = measured.grid.nodes()[torch.from_numpy(np.flatnonzero(measured.mask[0]))]
    speed = torch.linspace(0, 1, len(position))
    found = flow_regions(surface, position, speed, 1e-3)
    assert set(found) == {"jet", "near wall", "apex"}
    assert torch.equal(found["jet"], speed > 0.5)
    orifice = surface.centroids[surface.region > 0].mean(0)
    distance = np.linalg.norm(position.numpy() - orifice, axis=1)
    assert distance[found["apex"].numpy()].min() > np.median(distance)
    assert 0.1 < found["near wall"].double().mean() < 0.9


def test_spread_over_skill_of_a_known_error(measured):
    sigma = np.full_like(measured.velocity, 0.03)
    wrong = measured.with_velocity(np.nan_to_num(measured.velocity) + np.float32(0.06), sigma=sigma)
    right = measured.with_velocity(np.nan_to_num(measured.velocity))
    assert spread_over_skill(wrong, right).value == pytest.approx(0.5, rel=1e-3)
    assert spread_over_skill(right, right) is None
