"""The cut that the report draws, on flows where every pixel is known, and the choice of frames."""

from __future__ import annotations

from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest

import geometry
from torchsph import data
from torchsph.evaluation import figures as report
from torchsph.evaluation import metrics, slices


def linear(points, time):
    """Speed grows along x; all of it along the last axis."""
    return (1 + 50 * time) * points[:, :1] / 0.01 * np.eye(points.shape[1])[-1]


@pytest.mark.parametrize("dimension", [2, 3])
def test_cut_shows_the_field_inside_the_walls_alone(box_recording, dimension):
    recording = box_recording(linear, dimension=dimension, nodes=16)
    plane = slices.valve_plane(recording)
    picture = slices.cut(recording, recording.velocity[0], 0, plane, 0.25e-3)
    s, t = np.meshgrid(picture.across, picture.along)
    points = plane.origin + s[..., None] * plane.across + t[..., None] * plane.along
    inside = ((points > 0) & (points < 0.01)).all(-1)
    np.testing.assert_array_equal(np.isfinite(picture.speed), inside)
    # half a cell off the walls and farther in, the multilinear interpolation of a linear field is exact
    deep = ((points > 0.4e-3) & (points < 0.01 - 0.4e-3)).all(-1)
    np.testing.assert_allclose(picture.speed[deep], points[deep][:, 0] / 0.01, rtol=1e-5)
    np.testing.assert_allclose(np.abs(picture.velocity[1][deep]), abs(plane.along[-1]) * picture.speed[deep], rtol=1e-5)


def test_plane_passes_through_both_orifices_and_the_long_axis():
    recording = geometry.read_recording(data.sample_truth())
    plane, surface = slices.valve_plane(recording), recording.wall.at(0)
    normal = np.cross(plane.across, plane.along)
    for region in (1, 2):
        centre = surface.centroids[surface.part(region)].mean(0)
        assert abs((centre - plane.origin) @ normal) < 1e-5
    assert np.ptp(plane.extent[2:]) > 1.4 * np.ptp(plane.extent[:2])  # the ventricle stands upright


@pytest.mark.parametrize("regions", [{2: 0}, {1: 0, 2: 0}])
def test_plane_without_two_orifices(regions):
    recording = geometry.read_recording(data.sample_truth()).select(slice(0, 2))
    labels = np.array([regions.get(int(label), label) for label in recording.wall.region], np.uint8)
    plane = slices.valve_plane(replace(recording, wall=replace(recording.wall, region=labels)))
    for a, b, expected in (
        (plane.across, plane.across, 1),
        (plane.along, plane.along, 1),
        (plane.across, plane.along, 0),
    ):
        assert a @ b == pytest.approx(expected, abs=1e-9)
    assert slices.cut(recording, recording.velocity[0], 0, plane, 1e-3).speed.size > 100


def test_characteristic_frames_follow_the_motion(box_recording):
    times = tuple(0.01 * np.arange(12))
    late = box_recording(lambda p, t: linear(p, 0) * (t > 0.055), times=times)
    frames = report.characteristic_frames(late, 4)
    assert list(frames) == sorted(set(frames)) and len(frames) > 2 and frames.min() > 5
    still = box_recording(lambda p, _: 0 * p, times=times)
    assert len(report.characteristic_frames(still, 4)) == 4
    assert list(report.characteristic_frames(still.select(slice(0, 1)), 4)) == [0]


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("with_truth", [True, False])
def test_report_of_any_kind_of_recording(box_recording, dimension, with_truth, tmp_path):
    measured = box_recording(linear, dimension=dimension)
    truth = measured if with_truth else None
    analyses = {"spline": measured.with_velocity(0.9 * measured.velocity)}
    scores = {name: metrics.evaluate(one, truth, measured) for name, one in {"raw": measured, **analyses}.items()}
    report.draw_report(tmp_path / "report.png", measured, analyses, scores, truth, {"spline": 1.0})
    assert matplotlib.image.imread(tmp_path / "report.png")[..., :3].std() > 0.05


def test_table_leaves_out_what_nobody_has(box_recording):
    recording = box_recording(linear)
    heading, row = report.scores_table({"raw": metrics.evaluate(recording)}, {"raw": 0.25})
    assert heading == ["method", "div 1/s", "wall m/s", "flow rate", "seconds"]
    assert row[0] == "raw" and row[3] == "-" and row[-1] == "0.25"  # a still box has no flow rate to compare with


def test_forecast_picture(tmp_path):
    leads = [{"lead": t, "starts": 3, "nrmse": {"model": 5 * t, "persistence": 9 * t}} for t in (0.005, 0.01)]
    report.draw_forecast(tmp_path / "forecast.png", leads)
    assert matplotlib.image.imread(tmp_path / "forecast.png")[..., :3].std() > 0.05
