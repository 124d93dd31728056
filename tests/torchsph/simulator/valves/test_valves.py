"""Valves: the flux through an open one is dV/dt, sources follow continuity, every particle is accounted for."""

import math

import numpy as np
import pytest
import torch
from paths import SHARED_DATA

import geometry
from torchsph import PressureSource, Scene, Simulator, WeaklyCompressible, preset
from torchsph.simulator import advancing
from torchsph.simulator.state.clock import Clock
from torchsph.simulator.state.particles import Particles

VENTRICLE = geometry.Ventricle()
TIMES = np.arange(0.0, 0.4401, 0.01)


@pytest.fixture(scope="module")
def recording():
    return VENTRICLE.recording(TIMES, grid_spacing=2e-3, wall_spacing=1.5e-3)


@pytest.fixture(scope="module")
def scene(recording):
    return Scene.from_recording(recording, 2e-3)


def test_scene_takes_walls_valves_and_fluid_from_the_recording(scene):
    assert [valve.region for valve in scene.valves] == [1, 2]
    assert scene.valves[0].intervals == (VENTRICLE.beat.filling,)
    assert scene.fluid.density == 1060.0
    assert scene.walls is not None


@pytest.mark.parametrize(("start", "stop"), [(0.28, 0.31), (0.08, 0.12)], ids=["filling", "ejection"])
def test_the_open_valve_passes_what_the_volume_demands(scene, start, stop):
    """The particles' volume follows the cavity's through E wave and ejection, within the few of them that straddle."""
    run = Simulator(scene).start(start, seed=1)
    run.advance(stop)
    p, unit = run.particles, scene.spacing**3
    volume = float(p.mass[p.inside].sum()) * unit
    change = VENTRICLE.volume(stop) - VENTRICLE.volume(start)
    # with a flat profile the buffer passes the plane layer by layer (12 particles each at this spacing)
    layer = 12 * float(p.mass.mean()) * unit
    assert abs(volume - VENTRICLE.volume(stop)) < layer
    assert abs(change) > 5 * layer
    assert float(run.record.cavity_change) == pytest.approx(change, rel=0.01)  # of the mesh
    passed = run.record.inflow - run.record.outflow
    assert abs(float(passed.sum() - run.record.cavity_change)) < layer + abs(1 - float(run.record.filling)) * volume
    silent = passed[0, 1] if change > 0 else passed[0, 0]  # each valve's own flux: the other is shut
    assert float(silent) == 0.0
    assert not run.record.failed.any()
    assert int(run.record.crossed_wall.sum()) < 0.02 * p.count
    assert int(run.record.outside.sum()) == 0


def test_every_particle_is_accounted_for(scene):
    """Fluid now = fluid at the start + entered - left through a valve, whatever happens at the walls."""
    run = Simulator(scene).start(0.18, seed=0)
    before, volume = int(run.particles.inside.sum()), float(run.particles.mass[run.particles.inside].sum())
    run.advance(0.29)  # ejection ends, both valves shut, the inlet opens
    entered, left = int(run.record.inserted.sum()), int(run.record.removed.sum())
    assert int(run.particles.inside.sum()) == before + entered - left
    assert left > 0 and entered > 0
    passed = (run.record.inflow - run.record.outflow).sum() / scene.spacing**3
    assert float(run.particles.mass[run.particles.inside].sum()) == pytest.approx(volume + float(passed), rel=1e-5)
    assert float(run.record.filling) == pytest.approx(1.0, abs=0.03)
    assert int((run.particles.kind > 0).sum()) > 0  # the inlet's buffer is there, the outlet's is gone
    assert set(run.particles.kind.unique().tolist()) == {0, 1}


def test_buffer_carries_the_flux_and_keeps_an_imposed_profile(recording, scene):
    run = Simulator(scene).start(0.30, seed=0)
    mask = torch.from_numpy(np.ascontiguousarray(recording.mask[30]))
    nodes = recording.grid.nodes()
    centre = torch.tensor([*VENTRICLE.mitral_centre, 0.0])
    profile = -torch.exp(-(((nodes - centre)[:, :2].norm(dim=1) / 2e-3) ** 2)).reshape(recording.grid.shape)
    field = torch.zeros(3, *recording.grid.shape)
    field[2] = profile
    run.impose(recording.grid, field, mask)
    run.advance(0.302)
    p = run.particles
    buffer = p.position[~p.fluid] * scene.spacing
    inward = -p.velocity[~p.fluid][:, 2] * run.units.speed
    near = (buffer[:, :2] - centre[:2].float()).norm(dim=1)
    middle, rim = inward[near < 1.5e-3].mean(), inward[near > 2.8e-3].mean()
    assert middle > 2 * rim > 0
    area = math.pi * np.prod(np.array(VENTRICLE.mitral_semi_axes) * VENTRICLE.scales(0.302)[:2])
    assert float(inward.mean()) * area == pytest.approx(VENTRICLE.volume_rate(0.302), rel=0.3)


def source_acceleration(scene, model, place, time):
    """What the inlet's source does to a particle at ``place`` (1, 3), m, m/s^2."""
    domain = Simulator(scene, preset("thesis", valve=model), dtype=torch.float64).domain
    clock, nothing, label = Clock("cpu"), torch.zeros(1).double(), torch.zeros(1, dtype=torch.int64)
    clock.enter(time, time, (1,), 1.0)
    position = place.double() / domain.units.length
    particle = Particles(position, 0.0 * position, nothing, nothing + 1.0, label, label, 1)
    return domain.valves.acceleration(particle, clock) * domain.units.acceleration


def test_a_source_pushes_as_the_changing_flux_demands(scene):
    """Across a far half-sphere the acceleration carries d^2V/dt^2 (3.4 with Q from continuity)."""
    time, radius = 0.28, 0.2
    direction = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    centre = torch.tensor([*VENTRICLE.mitral_centre, 0.0], dtype=torch.float64)
    centre = centre * torch.from_numpy(VENTRICLE.scales(time))
    acceleration = source_acceleration(scene, PressureSource(core=0.5), centre + radius * direction, time)
    outward = float((acceleration * direction).sum())
    step = 1e-4
    second = (VENTRICLE.volume_rate(time + step) - VENTRICLE.volume_rate(time - step)) / (2 * step)
    assert outward * 2 * math.pi * radius**2 == pytest.approx(second, rel=0.05)


def test_a_source_stays_finite_at_its_centre(scene):
    centre = torch.tensor([[VENTRICLE.mitral_centre[0], 0.0, 0.0]], dtype=torch.float64)
    assert torch.isfinite(source_acceleration(scene, PressureSource(), centre, 0.3)).all()


def strays(run):
    """Particles neither within the walls, by the surface's winding number, nor beyond the plane of the inlet."""
    motion, points = run.domain.scene.walls, run.particles.position.double() * run.units.length
    surface = motion.surface(run.time)
    inside = geometry.winding_number(surface.vertices, surface.faces, points.numpy()) > 0.5
    inlet = next(orifice for orifice in geometry.orifices(motion) if orifice.label == 1).at(run.time)
    return int((~inside & (inlet.height(points).numpy() <= 0)).sum())


@pytest.mark.slow
def test_thesis_preset_loses_no_particle_without_saying(scene):
    run = Simulator(scene, preset("thesis")).start(0.27, seed=3)
    before = run.particles.count
    run.advance(0.29)
    left = int(run.record.removed.sum())
    assert run.particles.count == before - left
    assert strays(run) == int(run.record.outside.sum()) == 0
    assert not run.record.failed.any()
    low, high = run.record.summary()["density_range"]
    assert 0.2 < low[0] < 1.0 < high[0] < 2.0
    # one put two spacings beyond the wall is told of
    position = run.particles.position.clone()
    lowest = int(position[:, 2].argmin())
    wall = run.surroundings.sample(run.particles)
    position[lowest] -= (wall.distance[lowest] + 2.0) * wall.normal[lowest]
    run.particles = run.particles.changed(position=position)
    run.advance(run.time + 1e-6)
    assert strays(run) == int(run.record.outside.sum()) == 1


@pytest.mark.slow
@pytest.mark.phantom("lv_phantom_a.h5")
def test_one_beat_of_the_phantom_in_the_thesis_preset_stays_finite():
    """Finite, every particle accounted for, density range reported (2.5 mm)."""
    recording = geometry.read_recording(SHARED_DATA / "lv_phantom_a.h5")
    run = Simulator(Scene.from_recording(recording, 2.5e-3), preset("thesis")).start(float(recording.time[0]))
    mask = torch.from_numpy(np.ascontiguousarray(recording.mask[0]))
    run.impose(recording.grid, torch.from_numpy(recording.velocity[0]), mask)
    before = run.particles.count
    for time in recording.time[1:]:
        run.advance(float(time))
    summary = run.record.summary()
    print(before, run.particles.count, summary)
    assert not run.record.failed.any()
    assert torch.isfinite(run.particles.velocity).all()
    assert run.particles.count == before - int(run.record.removed.sum())


@pytest.mark.slow
def test_the_flow_through_a_valve_does_not_feel_how_often_neighbours_are_searched(recording, scene, monkeypatch):
    """Particles change sides where they cross, not when the list of neighbours happens to be made anew."""
    mask = torch.from_numpy(np.array(recording.mask[30], bool))
    fields, searches = [], []
    for margin in (0.1, 0.5):
        monkeypatch.setattr(advancing, "_SEARCH_MARGIN", margin)
        run = Simulator(scene, WeaklyCompressible(), dtype=torch.float64).start(0.30, seed=1)
        run.impose(recording.grid, torch.from_numpy(recording.velocity[30].astype(np.float64)), mask)
        run.advance(0.315)
        fields.append(run.fetch(recording.grid, mask).value)
        searches.append(run.record.searches)
    assert searches[0] > 1.5 * searches[1] and int(run.record.inserted.sum()) > 0
    assert float((fields[0] - fields[1]).norm()) < 1e-6 * float(fields[0].norm())
