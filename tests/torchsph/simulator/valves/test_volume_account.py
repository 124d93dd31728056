"""Volume that valves let in or out beyond what the walls ask for is told, and ends a member that it spoils."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

import geometry
from torchsph import NumericalFailure, Scene, Simulator, Valve, preset
from torchsph.simulator.failures import check_volume
from torchsph.simulator.state.record import Record


def record(*fillings: float) -> Record:
    made = Record(len(fillings), 1)
    made.filling = torch.tensor(fillings, dtype=torch.float64)
    return made


START = torch.ones(3, dtype=torch.float64)


def test_a_little_is_not_worth_a_word() -> None:
    noted = record(1.02, 0.98, 1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_volume(noted, START, 0.1)
    torch.testing.assert_close(noted.volume_error, torch.tensor([0.02, 0.02, 0.0], dtype=torch.float64))


def test_more_is_told_once_and_kept_in_the_record() -> None:
    noted = record(1.0, 0.93, 1.0)
    with pytest.warns(
        UserWarning, match=r"particles' volume is 7 % off that of the walls .* at about 0.1 s: .* look at"
    ):
        check_volume(noted, START, 0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_volume(noted, START, 0.2)
    noted.filling = torch.ones(3, dtype=torch.float64)
    check_volume(noted, START, 0.3)
    assert noted.summary()["volume_error"] == pytest.approx([0.0, 0.07, 0.0]) and not bool(noted.failed.any())


def test_what_spoils_a_result_ends_its_member_and_at_last_the_run() -> None:
    noted = record(1.0, 0.7, 1.25)
    with pytest.warns(UserWarning, match="30 % off"):
        check_volume(noted, START, 0.1)
    assert noted.failed.tolist() == [False, True, True]
    noted.filling = torch.zeros(3, dtype=torch.float64)
    with pytest.raises(
        NumericalFailure, match=r"all 3 members have failed \(volume more than 20 % off that of the walls"
    ):
        check_volume(noted, START, 0.2)


def test_a_start_with_a_free_surface_promises_no_volume() -> None:
    noted = record(0.9, 0.3, 0.0)
    check_volume(noted, torch.tensor([0.5, 0.1, 0.0], dtype=torch.float64), 0.1)
    assert not bool(noted.volume_error.any())


@pytest.mark.parametrize("open_until", [1.0, -1.0])
def test_a_cavity_that_grows_behind_open_and_shut_valves(open_until: float) -> None:
    """By a third in 20 ms: an open valve lets in what is missing; shut ones leave 25 % empty, which is no result."""
    body = geometry.ellipse((0.01, 0.014), 2e-3)
    region = (body.centroids[:, 1] > 0.011).astype(np.uint8)
    times = np.linspace(0.0, 0.02, 5)
    places = np.stack([body.vertices * (1 + t / 0.06) ** 0.5 for t in times])
    walls = geometry.WallMotion.through(times, places, body.faces, region)
    scene = Scene(1.5e-3, walls=walls, valves=(Valve(1, ((-2.0, open_until),)),), dimension=2)
    run = Simulator(scene, preset("weakly_compressible")).start(0.0)
    if open_until > 0:
        run.advance(0.02)
        assert float(run.record.volume_error) < 0.05 and not bool(run.record.failed.any())
        return
    with pytest.warns(UserWarning, match="off that of the walls"), pytest.raises(NumericalFailure, match="volume more"):
        run.advance(0.01)
        run.advance(0.02)
