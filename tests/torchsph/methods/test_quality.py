"""Quality codes of the ensemble's analyses, and one observation through the whole cycle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

import geometry
import regularize
from geometry import Quality
from torchsph import EnsembleOptions, PreparedMeasurement, assimilate, make_model
from torchsph.assimilation import Reason
from torchsph.methods.ensemble.divergence_cleaning import Cleaned
from torchsph.methods.ensemble.quality import analysed_codes, first_codes
from torchsph.methods.measurement.observation_batch import Part
from torchsph.methods.measurement.observation_operator import Measurement

SIZE = 0.02  # m
NODE = (6, 8)  # y, x of the node that is observed
KICK = 0.04  # m/s, by which it is off


def cells(points: np.ndarray, time: float) -> np.ndarray:
    """Steady vortices in a box, without divergence and tangential at its sides, m/s."""
    x, y = (np.pi * points / SIZE).T
    return 0.1 * np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y)], 1)


@pytest.fixture(name="measured")
def _measured(box_recording: Callable[..., geometry.Recording]) -> geometry.Recording:
    noise = np.random.default_rng(0).normal(0.0, 0.01, (2, 2, 14, 14)).astype(np.float32)
    clean = box_recording(cells, dimension=2, size=SIZE, nodes=12, times=(0.0, 0.005))
    weight = clean.mask.astype(np.float32)
    return replace(clean, velocity=clean.velocity + noise * clean.mask[:, None], weight=weight)


def test_one_observation_moves_the_analysis_there_and_says_so(
    measured: geometry.Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything but one node is silent in the last frame; without it the forecast is the analysis.

    What gives an analysis its balance of mass and frees it of divergence reaches everywhere: it is left out here.
    """
    monkeypatch.setattr(PreparedMeasurement, "balance", None)
    monkeypatch.setattr(
        "torchsph.methods.ensemble.analyses.without_divergence", lambda field, *_: Cleaned(field, 0.0, True)
    )
    silent, alone = measured.weight.copy(), measured.weight.copy()
    silent[1] = alone[1] = 0.0
    alone[1][NODE] = 1.0
    off = measured.velocity.copy()
    off[1, 0][NODE] += KICK
    options = EnsembleOptions(increments=("ensemble",), localisation=0.25, gross_error=None)

    def analysis(weight: np.ndarray) -> geometry.Recording:
        recording = replace(measured, weight=weight, velocity=off)
        prepared = PreparedMeasurement(recording, regularize.Smoother().fixed())  # frames choose nothing for each other
        return assimilate(prepared, make_model(recording, spacing=1.5e-3), members=8, options=options).recording

    without, found = analysis(silent), analysis(alone)
    np.testing.assert_array_equal(found.velocity[0], without.velocity[0])
    change = found.velocity[1] - without.velocity[1]
    wanted = off[1, 0][NODE] - without.velocity[1, 0][NODE]
    assert 0.05 < change[0][NODE] / wanted < 1.0
    size = np.linalg.norm(change, axis=0)
    distance = np.linalg.norm(np.indices(size.shape) - np.reshape(NODE, (2, 1, 1)), axis=0) * SIZE / 12
    # the localisation's radius, and the diagonal of a patch between whose corners the filter interpolates
    far = distance > 0.25 * SIZE * (1 + 0.2 * 2**0.5)
    assert far[measured.mask[1]].any() and size[far].max() < 1e-6 * size.max()
    assert size[NODE] > 0.5 * size.max()
    assert (found.sigma[1, 0][NODE] < without.sigma[1, 0][NODE]) and (found.sigma[0] == without.sigma[0]).all()

    inside = measured.mask[1]
    assert (found.quality[0][measured.mask[0]] == Quality.USED).all()
    assert found.quality[1][NODE] == Quality.USED and without.quality[1][NODE] == Quality.NO_DATA
    assert np.count_nonzero(found.quality[1][inside] == Quality.NO_DATA) == inside.sum() - 1
    assert (found.quality[~measured.mask] == Quality.OUTSIDE).all()


def test_each_code_is_told_for_its_reason(measured: geometry.Recording) -> None:
    prepared = PreparedMeasurement(measured)
    grid = measured.grid
    fine = geometry.Grid(grid.origin, tuple(s / 2 for s in grid.spacing), tuple(2 * n - 1 for n in grid.shape))
    covered = torch.ones(grid.shape, dtype=torch.bool)
    mask = torch.from_numpy(np.array(measured.mask[1], bool))
    inside = torch.nonzero(mask)
    covered[tuple(inside[5])] = False
    one = Measurement(prepared, grid, 0.0)
    seen = one.see(1)
    reason = torch.full((2, len(seen.node)), int(Reason.NO_WEIGHT), dtype=torch.uint8)
    reason[1, 0] = Reason.USED  # the other component of the same node
    reason[:, 1], reason[:, 2], reason[:, 3] = Reason.GROSS_ERROR, Reason.OUT_OF_REACH, Reason.NOT_PREDICTED
    reason[:, 5] = Reason.USED
    codes = analysed_codes([Part(one, seen, 0)], reason.flatten(), mask, covered, grid)
    expected = [Quality.USED, Quality.OUTLIER, Quality.OUT_OF_REACH, Quality.FAILED, Quality.NO_DATA, Quality.FAILED]
    assert codes[tuple(inside[:6].T)].tolist() == expected
    assert (codes[~mask] == Quality.OUTSIDE).all()

    every = torch.ones(fine.shape, dtype=torch.bool)
    other = Measurement(prepared, fine, 0.0)
    codes = analysed_codes([Part(other, seen, 0)], reason.flatten(), every, every, fine)
    assert [int(codes[tuple(2 * place)]) for place in inside[:5]] == expected[:5]
    nothing = analysed_codes([], torch.empty(0), mask, torch.ones_like(covered), grid)
    assert (nothing[mask] == Quality.NO_DATA).all()
    assert torch.equal(first_codes(one, mask) == Quality.USED, mask)


def test_codes_and_their_names_are_in_the_file(box_recording: Callable[..., geometry.Recording], tmp_path) -> None:
    plain = box_recording(lambda points, t: 0 * points, nodes=4)
    quality = np.where(plain.mask, int(Quality.NO_DATA), 0)
    path = tmp_path / "analysis.h5"
    geometry.write_recording(path, replace(plain, quality=quality))
    back = geometry.read_recording(path)
    assert back.quality.dtype == np.uint8
    np.testing.assert_array_equal(back.quality, quality)
    with h5py.File(path) as file:
        names = file["quality"].attrs["names"]
        assert file.attrs["format_version"] == 1
    assert list(names) == ["outside", "used", "no data", "outlier", "out of reach", "failed", "ambiguous"]
    assert back.select([1]).quality.shape == quality[1:2].shape and back.with_velocity(back.velocity).quality is None
    geometry.write_recording(path, plain)
    assert geometry.read_recording(path).quality is None
    with pytest.raises(geometry.RecordingError, match="/quality"):
        replace(plain, quality=quality[:1])
