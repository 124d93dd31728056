"""What stands in a page: curves of any form, verdicts on measurements, pathlines that follow the flow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from torchsph.cli.quantity_tables import QuantityTables
from torchsph.haemodynamics import beat_numbers, summary
from torchsph.report import curves_of, measurement_checks
from torchsph.report.curves import beat_table
from torchsph.report.pathlines import pathlines

TIMES = tuple(0.01 * n for n in range(6))


def uniform(points: np.ndarray, time: float) -> np.ndarray:
    return np.tile([0.0, 0.1, 0.0], (len(points), 1))


def verdicts(measured, analysis, estimates=None) -> dict[str, tuple[str, str]]:
    return {check.name: (check.verdict, check.found) for check in measurement_checks(measured, analysis, estimates)}


# --- curves ---------------------------------------------------------------------------------------


def test_curves_with_and_without_bands():
    document = {
        "time": [0.0, 0.01],
        "units": {"kinetic_energy": "J", "flow_inlet": "m3/s", "volume": "m3"},
        "curves": {
            "analysis": {"volume": [5e-6, 4e-6], "kinetic_energy": [0.9e-4, 1.8e-4]},
            "truth": {"kinetic_energy": [1.1e-4, 2.1e-4]},
        },
        "members": {
            "curves": {
                "kinetic_energy": {
                    "mean": [1e-4, 2e-4],
                    "deviation": [0, 0],
                    "low": [8e-5, None],
                    "high": [1.2e-4, None],
                },
                "flow_inlet": {"time": [0.0, 0.005, 0.01], "value": [1e-5, 2e-5, 3e-5]},
            }
        },
    }
    energy, inlet, volume = (curve.plain() for curve in curves_of(document))
    assert [one["name"] for one in (energy, inlet, volume)] == ["Kinetic energy", "Flow through the inlet", "Volume"]
    assert [one["unit"] for one in (energy, inlet, volume)] == ["µJ", "ml/s", "ml"]
    assert [line["label"] for line in energy["lines"]] == ["analysis", "members", "truth"]
    analysis, members, truth = energy["lines"]
    assert members["values"] == [100.0, 200.0] and members["low"] == [80.0, None]
    assert analysis["low"] is None and truth["values"] == [110.0, 210.0]
    assert inlet["lines"][0]["time"] == [0.0, 0.005, 0.01] and inlet["lines"][0]["values"] == [10.0, 20.0, 30.0]


def test_what_quantify_writes_is_understood(box_recording):
    """Curves, bands and numbers of the beat, from the document as the command line makes it."""
    flow = box_recording(uniform, times=TIMES)
    curves = QuantityTables.of(flow, None, flow)
    members = {name: np.stack([row, 1.2 * row, 0.8 * row]) for name, row in curves.curves["analysis"].items()}
    bands = {name: summary(rows) for name, rows in members.items()}
    beat = {name: summary(rows) for name, rows in beat_numbers(flow.time, members).items()}
    document = QuantityTables(flow.time, curves.kind, curves.curves, bands, beat).document({})
    energy = next(one for one in curves_of(document) if one.name == "kinetic_energy")
    assert [line.label for line in energy.lines] == ["analysis", "members", "truth"]
    np.testing.assert_array_equal(energy.lines[1].low, bands["kinetic_energy"].low)
    heading, *rows = beat_table(document)
    assert heading == ["number", "unit", "analysis", "truth", "members", "nine of ten within"]
    peak = next(row for row in rows if row[0] == "kinetic energy peak")
    exact = 0.5 * 1060 * 0.1**2 * 1e-6  # J, of a millilitre at 0.1 m/s
    assert float(peak[2]) == pytest.approx(1e6 * exact, rel=5e-3) and peak[1] == "µJ" and peak[3] == peak[2]
    assert " to " in peak[5] and not [row for row in rows if set(row[2:]) == {"-"}]


@pytest.mark.parametrize(
    "curves",
    [None, [], {"analysis": None}, {"analysis": {"a": 3}}, {"analysis": {"a": "text"}}, {"analysis": {"a": [1.0]}}],
)
def test_what_is_no_curve_is_left_out(curves):
    assert curves_of({"time": [0.0, 1.0], "units": None, "curves": curves}) == []


# --- verdicts -------------------------------------------------------------------------------------


def noisy(box_recording, deviation: float, **more):
    """A flow, and a measurement of it with white noise (m/s)."""
    flow = box_recording(uniform, times=TIMES)
    noise = np.random.default_rng(0).normal(0, deviation, flow.velocity.shape) * flow.mask[:, None]
    return flow, replace(flow, velocity=(flow.velocity + noise).astype(np.float32), **more)


def test_the_noise_that_is_found_stands_beside_the_stated_one(box_recording):
    flow, measured = noisy(box_recording, 0.02)
    verdict, found = verdicts(measured, flow)["Noise"]
    assert verdict == "good" and "the file states none" in found
    values = [float(part.split()[1]) for part in found.split(" m/s")[0].removeprefix("found ").split(", ")]
    np.testing.assert_allclose(values, 0.02, rtol=0.1)
    for stated, expected in ((0.02, "good"), (0.005, "poor"), (0.0, "poor"), (0.08, "fair")):
        told = replace(measured, sigma=np.full_like(flow.velocity, stated))
        assert verdicts(told, flow)["Noise"][0] == expected


def test_holes_and_silent_frames_are_told(box_recording):
    flow, measured = noisy(box_recording, 0.02)
    weight = np.asarray(flow.mask, np.float32).copy()
    weight[2] = 0
    weight[:, :, :, 6:] = 0
    verdict, found = verdicts(replace(measured, weight=weight), flow)["Coverage"]
    inside = flow.mask.sum()
    assert verdict == "fair" and f"{100 * (weight > 0).sum() / inside:.0f} % of the blood" in found
    assert "1 of 6 frames hold nothing" in found
    assert verdicts(measured, flow)["Coverage"] == ("good", "100 % of the blood was measured, 100 % in the worst frame")


def test_outliers_are_counted(box_recording):
    flow, measured = noisy(box_recording, 0.02)
    assert verdicts(measured, flow)["Outliers"][0] == "good"
    velocity = measured.velocity.copy()
    chosen = np.zeros(flow.mask.shape, bool)
    chosen[:, 3:8:4, 2:9:3, 3:8:4] = True  # far apart: outliers among outliers are usual there
    velocity[np.broadcast_to(chosen[:, None], velocity.shape)] += 0.6
    share = (chosen & flow.mask).sum() / flow.mask.sum()
    verdict, found = verdicts(replace(measured, velocity=velocity), flow)["Outliers"]
    assert verdict == "fair" and float(found.split()[0]) == pytest.approx(100 * share, rel=0.1)
    quality = np.asarray(flow.mask, np.uint8).copy()
    quality[chosen & flow.mask] = 3
    verdict, found = verdicts(measured, replace(flow, quality=quality))["Outliers"]
    assert verdict == "fair" and float(found.split()[0]) == pytest.approx(100 * share, rel=0.05)


def test_flicker_wrapping_and_the_frame_rate(box_recording):
    flow, measured = noisy(box_recording, 0.001)
    found = verdicts(measured, flow, {"wall": {"noise_m": 4e-4}})
    assert found["Walls"] == ("fair", "flicker by 0.4 mm, 0.32 grid spacings")
    assert verdicts(measured, flow)["Walls"][0] == "good"
    assert found["Aliasing"][0] == "good"
    passed = 0.1 * 0.01 / (0.01 / 8)
    assert found["Frame rate"] == (
        "good",
        f"100 frames a second; the fastest blood passes {passed:.1f} grid spacings between two",
    )

    def ramp(points: np.ndarray, time: float) -> np.ndarray:
        field = np.zeros_like(points)
        field[:, 0] = 120 * points[:, 1]
        return field

    true = box_recording(ramp, times=TIMES)
    limit = 0.5
    wrapped = replace(true, velocity=(true.velocity + limit) % (2 * limit) - limit)
    assert verdicts(wrapped, true)["Aliasing"][0] == "poor"
    assert verdicts(true, true)["Aliasing"][0] == "good"
    told = replace(wrapped, nyquist=np.full(wrapped.frames, limit))
    assert verdicts(told, true)["Aliasing"] == ("good", "wraps at 0.5 m/s, which is known and was taken back")


# --- pathlines ------------------------------------------------------------------------------------


def test_pathlines_follow_the_flow_and_never_run_out(box_recording):
    flow = box_recording(uniform, times=TIMES, nodes=12)
    paths = pathlines(flow, 80, steps=2)
    assert paths.places.shape == (11, 80, 3) and np.allclose(np.diff(paths.time), 0.005)
    assert paths.begins[0].all() and 0 < paths.begins[1:].mean() < 0.5
    step = np.diff(paths.places, axis=0)
    inner = ~paths.begins[1:] & (paths.places[1:, :, 1] < 0.0095)  # the far wall, which nothing passes, holds them up
    assert inner.sum() > 200
    np.testing.assert_allclose(step[inner], np.array([0.0, 5e-4, 0.0]) * np.ones((inner.sum(), 1)), atol=2e-7)
    assert (paths.places > -1e-3).all() and (paths.places < 0.0112).all()


def test_blood_that_comes_in_gets_tracers(box_recording):
    """Downwards through the open side: without new ones the upper half would be empty."""

    def down(points: np.ndarray, time: float) -> np.ndarray:
        return np.tile([0.0, 0.0, -0.15], (len(points), 1))

    flow = box_recording(down, times=TIMES, nodes=12, valve_intervals=np.array([[1, -1.0, 1.0]]))
    last = pathlines(flow, 300).places[-1]
    assert (last[:, 2] > 0.005).mean() > 0.25
