"""Velocities that tell of another flow than the walls are found out; blur and noise are not taken for it."""

from dataclasses import replace

import numpy as np
import pytest

import geometry


@pytest.fixture(scope="module")
def ventricle() -> geometry.Recording:
    """A whole beat of the analytic ventricle, with a plug through whichever opening is open."""
    shape = geometry.Ventricle()
    time = np.linspace(0.0, shape.beat.period, 16, endpoint=False)
    return shape.recording(time, grid_spacing=3e-3, wall_spacing=3e-3, periodic=True)


def with_plug(recording: geometry.Recording, factor: float) -> geometry.Recording:
    """Everywhere the velocity that the open opening's plug has, times a factor."""
    motion = geometry.WallMotion.from_recording(recording)
    field = np.zeros_like(recording.velocity)
    for frame, time in enumerate(recording.time):
        for opening in geometry.orifices(motion):
            t, rate = float(time), motion.volume_rate(float(time))
            if (rate > 0) == (opening.label == 1):
                plug = opening.velocity(t) - rate / opening.area(t) * opening.normal(t)
                field[frame] = factor * plug[:, None, None, None]
    noise = 0.05 * np.abs(field).max() * np.random.default_rng(0).standard_normal(field.shape)
    return replace(recording, velocity=(field + noise).astype(np.float32) * recording.mask[:, None])


@pytest.mark.parametrize("factor", [0.7, 1.0])
def test_a_flow_that_walls_and_velocities_share_is_not_doubted(ventricle, factor):
    found = geometry.estimated(with_plug(ventricle, factor))
    assert found.flow.ratio == pytest.approx(factor, abs=0.1) and not found.contradicted
    assert "flow" not in found.summary() and not any("both are weighed" in text for text in found.warnings)


def test_nothing_measured_contradicts_nothing(ventricle):
    assert geometry.estimated(ventricle).flow is None


@pytest.mark.parametrize("factor", [0.1, 2.5])
def test_a_contradiction_is_said_and_noted(ventricle, factor):
    found = geometry.estimated(with_plug(ventricle, factor))
    assert found.flow.ratio == pytest.approx(factor, rel=0.15, abs=0.05) and found.contradicted
    assert found.summary()["flow"]["velocities_over_walls"] == found.flow.ratio
    assert "both are weighed" in found.warnings[-1]
