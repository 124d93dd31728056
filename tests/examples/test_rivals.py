"""Rivals: each does what its idea promises, on flows whose answer is known, and every row says where it comes from."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
import torch
from paths import ROOT

if str(ROOT) not in sys.path:
    sys.path.append(str(ROOT))

import geometry
from examples.rivals.__main__ import OWN, page
from examples.rivals.cases import CASES
from examples.rivals.frames import confidence, divergence_rows, laplacian_rows, wall_rows
from examples.rivals.methods import denoiser, gaussian, ivfm, leray, pinn, siren, smoothn, temporal
from examples.rivals.methods.sine import Samples, SineField
from examples.rivals.registry import RIVALS
from torchsph.ultrasound import NoiseModel, measure_noise

TABLE = ROOT / "examples" / "rivals" / "results" / "rivals.json"


def swirl(points, time):
    """A solid rotation about z that grows: no divergence, tangential to a round wall."""
    return (1 + 10 * time) * 20 * np.stack([-points[:, 1], points[:, 0], np.zeros(len(points))], 1)


@pytest.fixture(scope="module")
def truth():
    """The rotation in a ventricle at rest."""
    still = geometry.Ventricle(beat=geometry.Beat(stroke_fraction=1e-6))
    return still.recording([0.0, 0.01, 0.02], grid_spacing=1.5e-3, wall_spacing=1.5e-3, velocity=swirl)


@pytest.fixture(scope="module")
def measured(truth):
    draw = np.random.default_rng(0)
    noise = 0.06 * draw.standard_normal(truth.velocity.shape).astype(np.float32)
    return truth.with_velocity(np.where(np.asarray(truth.mask)[:, None], truth.velocity + noise, 0))


def error(found, truth):
    mask = np.asarray(truth.mask, bool)
    wrong = np.moveaxis(found - truth.velocity, 1, -1)[mask]
    return float(np.linalg.norm(wrong) / np.linalg.norm(np.moveaxis(truth.velocity, 1, -1)[mask]))


@pytest.mark.parametrize(
    ("fit", "part"),
    [
        (gaussian.fit, 0.6),
        (smoothn.fit, 0.5),
        (leray.fit, 0.6),
        (lambda recording: ivfm.fit(recording, smoothness=3.0), 0.5),
        (lambda recording: temporal.fit(recording, on=gaussian.fit), 0.5),
        (lambda recording: siren.fit(recording, frequency=1.0, steps=80, wall=0.1, size=512), 0.5),
        (lambda recording: pinn.fit(recording, frequency=1.0, steps=80, wall=0.1, size=512), 0.5),
    ],
    ids=["gaussian", "smoothn", "leray", "ivfm", "temporal", "siren", "pinn"],
)
def test_a_rival_takes_noise_away(fit, part, truth, measured):
    """From .6 of the flow to at most this part of it."""
    assert error(fit(measured), truth) < part * error(measured.velocity, truth)


def test_operators_are_exact_on_linear_fields(truth):
    mask = np.asarray(truth.mask[0], bool)
    points = truth.grid.nodes().numpy()[mask.reshape(-1)]
    rows = divergence_rows(mask, truth.grid.spacing)
    assert np.abs(rows @ swirl(points, 0.0).T.reshape(-1)).max() < 1e-9
    np.testing.assert_allclose(rows @ points.T.reshape(-1), 3.0, rtol=1e-9)  # div x = 3
    constant = laplacian_rows(mask) @ np.ones(len(points))
    assert np.abs(constant).max() == 0


def test_nothing_of_the_rotation_goes_through_the_walls(truth):
    motion = geometry.WallMotion.from_recording(truth)
    mask = np.asarray(truth.mask[0], bool)
    rows, asked = wall_rows(truth, motion, 0)
    points = truth.grid.nodes().numpy()[mask.reshape(-1)]
    through = rows @ swirl(points, 0.0).T.reshape(-1) - asked
    half_angle = 0.5 * 1.5e-3 / 9e-3  # by which the normal of a flat face is off at its ends
    assert len(through) > 50 and np.sqrt((through**2).mean()) < half_angle * 20 * 9e-3


def test_the_projection_is_one(measured):
    """Projecting twice changes nothing more, and the rows have no divergence left."""
    once = leray.fit(measured, fwhm=2e-3)
    mask = np.asarray(measured.mask[0], bool)
    rows = divergence_rows(mask, measured.grid.spacing)
    before = rows @ gaussian.fit(measured, fwhm=2e-3)[0][:, mask].reshape(-1)
    assert np.linalg.norm(rows @ once[0][:, mask].reshape(-1)) < 1e-3 * np.linalg.norm(before)


def test_smoothn_drops_an_outlier(truth):
    spoilt = np.array(truth.velocity)
    where = tuple(np.argwhere(np.asarray(truth.mask[0]))[200])
    spoilt[(0, slice(None), *where)] = 5.0
    here = (0, slice(None), *where)
    plain, robust = (
        np.abs(
            smoothn.fit(truth.with_velocity(spoilt), strength=1.0, rounds=rounds)[here]
            - smoothn.fit(truth, strength=1.0, rounds=rounds)[here]
        ).max()
        for rounds in (1, 5)
    )
    assert robust < 0.1 * plain


def test_derivatives_carried_along_are_those_of_autodiff():
    network = SineField(3, 2.0, 16, 2, torch.Generator().manual_seed(0))
    points = torch.randn(5, 4, generator=torch.Generator().manual_seed(1))
    value, slope = network(points)
    by_autodiff = torch.func.vmap(torch.func.jacrev(lambda x: network(x[None])[0][0]))(points)
    torch.testing.assert_close(slope, by_autodiff.mT, rtol=1e-4, atol=1e-5)
    assert value.shape == (5, 3)


def test_a_curl_has_no_divergence():
    network = SineField(3, 2.0, 16, 2, torch.Generator().manual_seed(0)).double()
    points = torch.randn(4, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    eye = torch.eye(4, dtype=torch.float64)

    def flow(x):
        value, slope = 2.0 * x[None], 2.0 * eye[None]
        for layer in network.layers[:-1]:
            inner = layer(value)
            value, slope = inner.sin(), inner.cos()[:, None] * (slope @ layer.weight.T)
        return siren.curl(value, slope @ network.layers[-1].weight.T)[0]

    jacobian = torch.func.vmap(torch.func.jacrev(flow))(points)[:, :, :3]
    trace = jacobian.diagonal(dim1=1, dim2=2).sum(1)
    assert trace.abs().max() < 1e-12 * jacobian.abs().max() + 1e-12


def test_momentum_of_a_solid_rotation_is_balanced_by_its_pressure():
    """v = omega x r and p = omega^2 r^2 / 2 (over rho) satisfy the equations of an inviscid fluid."""
    omega = 1.7
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    x, y, _ = points.unbind(1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    value = torch.stack([-omega * y, omega * x, zero, 0.5 * omega**2 * (x**2 + y**2)], 1)
    slope = torch.zeros(20, 4, 4)  # [point, direction, component]
    slope[:, 1, 0], slope[:, 0, 1] = -omega * one, omega * one
    slope[:, 0, 3], slope[:, 1, 3] = omega**2 * x, omega**2 * y
    empty = torch.zeros(0)
    data = Samples(empty, empty, empty, empty, empty, empty, length=0.01, duration=0.02, speed=0.2)
    mass, momentum = pinn.residuals(value, slope, data)
    assert mass < 1e-12 and momentum < 1e-10
    slope[:, 3, 0] = 1.0  # it would have to be driven
    assert pinn.residuals(value, slope, data)[1] > 0.1


def test_a_denoiser_begins_as_the_gaussian_and_learns(truth):
    """.50 with the Gaussian, .38 after 60 steps, on noise that it has not seen."""
    tracked = measure_noise(truth, NoiseModel(), seed=3)
    inputs, unit = denoiser.seen(tracked)
    with torch.no_grad():
        begin = denoiser.Network()(inputs).numpy() * unit
    np.testing.assert_allclose(begin, gaussian.fit(tracked, fwhm=denoiser.FWHM), atol=1e-6)
    network = denoiser.trained([truth], steps=60, seed=0)
    with torch.no_grad():
        learned = network(inputs).numpy() * unit
    assert error(learned, truth) < 0.85 * error(begin, truth)


def test_confidence_is_zero_where_nothing_was_measured(measured):
    spoilt = np.array(measured.velocity)
    where = tuple(np.argwhere(np.asarray(measured.mask[0]))[10])
    spoilt[(0, 0, *where)] = np.nan
    weight = confidence(measured.with_velocity(spoilt))
    assert weight[(0, *where)] == 0 and weight.max() == 1
    assert not weight[~np.asarray(measured.mask, bool)].any()


def test_rows_of_the_table_are_of_rivals_that_are_there_and_were_tuned_elsewhere():
    table = json.loads(TABLE.read_text(encoding="utf-8"))
    for key, rows in table["rows"].items():
        for name, row in rows.items():
            assert len(row["from"]["commit"]) == 40 and 0 < row["nrmse"] < 1.6
            if name not in ("raw", *OWN):
                assert row["settings"] == table["settings"][name][CASES[key].tuned_at]["settings"]
                assert name in RIVALS and name not in CASES[key].leaves_out


def test_the_page_names_every_row_best_first():
    row = {"nrmse": 0.5, "direction_error_deg": 20.0, "divergence_rms": 1.0, "seconds": 2.0}
    text = page({"rows": {"measured": {"gaussian": row, "ensemble": row | {"nrmse": 0.4, "energy_loss": 0.8}}}})
    lines = [line for line in text.splitlines() if line.startswith("| ")][1:]
    assert lines == [
        "| **ensemble** | 0.400 | 20.0 | 1.00 | 0.80 |  | 2.0 |",
        "| gaussian | 0.500 | 20.0 | 1.00 |  |  | 2.0 |",
    ]
