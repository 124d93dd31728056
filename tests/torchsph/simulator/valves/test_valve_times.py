"""When valves are open: beat after beat, for an instant, against the flow, or not at all while the volume changes."""

from dataclasses import replace

import numpy as np
import pytest

import geometry
from torchsph import Projection, Scene, Simulator, preset
from torchsph.simulator.scene import Valve

VENTRICLE = geometry.Ventricle()


def test_intervals_repeat_with_their_period():
    """As the fractional beat says; an interval over the end of the beat, and spans of several beats, included."""
    once = Valve(1, ((0.1, 0.3), (0.7, 0.9)), period=0.8, span=(0.0, 0.8))
    for time in np.arange(-1.95, 3.0, 0.1) + 0.003:
        beat = time % 0.8
        assert once.is_open(time) == (0.1 <= beat < 0.3 or beat >= 0.7 or beat < 0.1), time
    beats = Valve(1, ((0.1, 0.2), (0.5, 0.7)), period=0.4, span=(0.0, 0.8))  # each recorded beat keeps its own times
    assert [beats.is_open(t) for t in (0.15, 0.55, 0.65, 0.25, 1.05, 1.45)] == [True, True, True, False, True, True]
    bare = Valve(1, ((0.1, 0.2),), period=0.5)
    assert bare.is_open(10.15) and not bare.is_open(10.25) and not Valve(1, ((0.1, 0.2),)).is_open(10.15)
    assert np.allclose(Valve(1, ((0.1, 0.2),), 0.5, (0.0, 0.5)).events(0.9, 1.3), [1.0, 1.1, 1.2])
    with pytest.raises(ValueError, match="intervals that repeat must be finite"):
        Valve(1, ((0.1, np.inf),), period=0.5)
    with pytest.raises(ValueError, match="must cover the period"):
        Valve(1, ((0.1, 0.2),), 0.5, (0.0, 0.4))


def test_a_recordings_valves_go_on_with_its_beat():
    times = np.arange(0.0, VENTRICLE.beat.period, 0.05)
    recording = VENTRICLE.recording(times, grid_spacing=5e-3, wall_spacing=4e-3)
    scene = Scene.from_recording(replace(recording, period=VENTRICLE.beat.period), 3e-3)
    period = scene.walls.period
    assert period > 0 and scene.valves
    seen = replace(recording, period=VENTRICLE.beat.period, valve_intervals=None)  # open at the end: until it ends
    for valve in Scene.from_recording(seen, 3e-3).valves:
        assert np.isfinite(valve.intervals).all() and valve.is_open(0.3) == valve.is_open(0.3 + period)
    for valve in scene.valves:
        assert valve.period == period
        for time in np.linspace(0.01, period, 40):
            assert valve.is_open(time) == valve.is_open(time + 3 * period)


def swelling(rate, duration, key_step=None, spacing=2e-3):
    """A ventricle that grows, or shrinks, evenly in every direction; relative rate (1/s)."""
    body = VENTRICLE.surface(2e-3)
    times = np.linspace(0.0, duration, 5) if key_step is None else np.arange(0.0, duration + key_step, key_step)
    places = np.stack([body.vertices * (1 + rate * t) for t in times])
    return geometry.WallMotion.through(times, places, body.faces, body.region)


def run_between(walls, valves, scheme, until, spacing=2e-3, seed=0):
    run = Simulator(Scene(spacing=spacing, walls=walls, valves=valves), scheme).start(0.0, seed=seed)
    run.advance(until)
    return run


@pytest.mark.parametrize("scheme", [preset("weakly_compressible"), Projection()], ids=["compressible", "projection"])
def test_backflow_through_an_outlet_is_survived(scheme):
    """The aortic valve stays open while the cavity grows: blood comes back through it as the volume asks for."""
    walls = swelling(1.0, 0.04)
    valve = Valve(2, ((-1.0, 1.0),))
    run = run_between(walls, (valve,), scheme, 0.04)
    volume = walls.volume(0.04) - walls.volume(0.0)
    assert float(run.record.inflow.sum() - run.record.outflow.sum()) == pytest.approx(volume, rel=0.2)
    assert float(run.record.filling) == pytest.approx(1.0, abs=0.03)
    assert int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())
    assert float(run.record.largest_density) < 1.1


@pytest.mark.parametrize("scheme", [preset("weakly_compressible"), Projection()], ids=["compressible", "projection"])
def test_a_valve_that_opens_for_less_than_a_step(scheme):
    """Open for 10 microseconds: the flow through it is that of those, and nothing breaks."""
    run = run_between(swelling(0.5, 0.02), (Valve(1, ((0.01, 0.01001),)),), scheme, 0.015)
    assert int(run.record.inserted.sum()) <= 12 and not bool(run.record.failed.any())
    assert set(run.particles.kind.unique().tolist()) == {0}


@pytest.mark.parametrize("rate", [-1.0, 1.0])
def test_a_closed_cavity_that_changes_its_volume_is_reported_in_the_default_scheme(rate):
    """The fluid's density takes it up, and says so: the filling, and the range of densities; no leak, no failure."""
    walls = swelling(rate, 0.02)
    run = run_between(walls, (Valve(1, ((5.0, 6.0),)),), preset("weakly_compressible"), 0.02)
    ratio = walls.volume(0.0) / walls.volume(0.02)
    assert float(run.record.filling) == pytest.approx(ratio, rel=1e-6)
    mean = 1 + float(run.particles.deviation.mean())
    assert mean == pytest.approx(ratio, abs=0.25 * abs(ratio - 1))
    assert int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())


@pytest.mark.parametrize("step", [1e-3, 50e-3])
def test_key_frames_near_and_far_pump_alike(step):
    """Frames 1 ms and 50 ms apart, without velocities of their walls: the cavity fills by its change of volume."""
    walls = swelling(1.0, 0.05, step)
    run = run_between(walls, (Valve(1, ((-1.0, 1.0),)),), preset("weakly_compressible"), 0.05, spacing=2.5e-3)
    assert float(run.record.filling) == pytest.approx(1.0, abs=0.02)
    assert int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())


@pytest.mark.slow
def test_a_wall_of_a_hundred_thousand_faces_pumps():
    body = VENTRICLE.surface(0.18e-3)
    assert len(body.faces) > 100_000
    times = np.array([0.0, 0.01])
    walls = geometry.WallMotion.through(times, body.vertices * (1 + times)[:, None, None], body.faces, body.region)
    run = run_between(walls, (Valve(1, ((-1.0, 1.0),)),), preset("weakly_compressible"), 0.005, spacing=2.5e-3)
    assert float(run.record.filling) == pytest.approx(1.0, abs=0.02)
    assert int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())
