"""Walls that flicker reach splines and simulator as one estimated motion, and the results say so."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import geometry
import torchsph as ts
from torchsph.data import sample_measurement
from torchsph.methods.by_name import run_methods


@pytest.fixture(name="flickering", scope="module")
def _flickering() -> geometry.Recording:
    """The sample, its walls scaled by an independent percent in each frame."""
    sample = geometry.read_recording(sample_measurement())
    factors = 1.0 + 0.01 * np.random.default_rng(0).standard_normal(sample.frames)
    vertices = np.asarray(sample.wall.vertices) * factors[:, None, None]
    return replace(sample, wall=replace(sample.wall, vertices=vertices, velocity=None))


def test_scene_and_splines_see_the_same_estimated_motion(flickering):
    found = geometry.estimated(flickering)
    assert found.wall.uncertain
    scene = ts.Scene.from_recording(flickering, 2e-3)
    np.testing.assert_array_equal(scene.walls.vertices_at_keys[: flickering.frames], found.wall.vertices)
    with pytest.warns(UserWarning, match="the walls' volume jitters by .* ml between frames"):
        prepared = ts.PreparedMeasurement(flickering)
    np.testing.assert_array_equal(prepared.recording.wall.vertices, found.wall.vertices)
    np.testing.assert_array_equal(prepared.splines.motion.vertices_at_keys[0], found.wall.vertices[0])


def test_exact_walls_are_left_alone_without_a_word():
    sample = geometry.read_recording(sample_measurement())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ts.PreparedMeasurement(sample).recording is sample


@pytest.mark.slow
def test_results_say_what_was_mended(flickering):
    few = flickering.select(slice(0, 8))
    with pytest.warns(UserWarning, match="jitters"):
        info = run_methods(few, ("spline",))["spline"].info
    assert info["estimates"]["wall"]["noise_m"] > 1e-5
