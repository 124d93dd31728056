"""Gradients through imposing, advancing and fetching, against differences in double precision; the memory they take.

What is differentiated are whole forecasts: moving walls, valves that pass flow, both schemes. Solves are tight where
differences are taken, because a loose one is no function of its arguments to the last digits.
"""

import dataclasses
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

import geometry
from torchsph import Projection, Scene, Simulator, Valve, WeaklyCompressible, preset
from torchsph.simulator.scene import Fluid

TIGHT = {"tolerance": 1e-9, "iterations": 3000}
BOX = Scene(spacing=1 / 16, fluid=Fluid(1.0, 0.01), period=(1.0, 1.0), dimension=2)
SCHEMES = {"default": Projection(**TIGHT), "weakly_compressible": WeaklyCompressible(sound_speed=10.0)}


def draw(shape, seed):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def stirred(scheme, velocity, until=0.02, *, differentiable=True, **parameters):
    """A sum over the particles of a stirred box after a while, each with its own weight, and the run."""
    run = Simulator(BOX, scheme, dtype=torch.float64, differentiable=differentiable).start(0.0, seed=1)
    run.change(**parameters)
    run.particles = run.particles.changed(velocity=velocity)
    run.advance(until)
    p, weight = run.particles, draw(velocity.shape, 5)
    return (p.velocity * weight).sum() + (p.position * weight.flip(1)).sum(), run


def difference(function, step):
    return (float(function(step)) - float(function(-step))) / (2 * step)


@pytest.mark.parametrize("name", SCHEMES)
def test_of_a_box_in_its_velocities_and_its_viscosity(name):
    start, direction = draw((256, 2), 2), draw((256, 2), 3)
    velocity = start.clone().requires_grad_()
    viscosity = torch.tensor(0.01, dtype=torch.float64, requires_grad=True)
    end, _ = stirred(SCHEMES[name], velocity, viscosity=viscosity)
    by_velocity, by_viscosity = torch.autograd.grad(end, (velocity, viscosity))

    def moved(by):
        return stirred(SCHEMES[name], start + by * direction, viscosity=0.01, differentiable=False)[0]

    def thicker(by):
        return stirred(SCHEMES[name], start, viscosity=0.01 + by, differentiable=False)[0]

    assert float((by_velocity * direction).sum()) == pytest.approx(difference(moved, 1e-6), rel=1e-4)
    assert float(by_viscosity) == pytest.approx(difference(thicker, 1e-6), rel=1e-4)


def test_in_the_speed_of_sound_of_each_member():
    start = draw((512, 2), 2)

    def end(sound, differentiable=False):
        simulator = Simulator(BOX, SCHEMES["weakly_compressible"], dtype=torch.float64, differentiable=differentiable)
        run = simulator.start(0.0, members=2, seed=1)
        run.change(sound_speed=sound)
        run.particles = run.particles.changed(velocity=start)
        run.advance(0.02)
        return (run.particles.velocity * draw(start.shape, 5)).sum()

    sound = torch.tensor([10.0, 12.0], dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(end(sound, True), sound)
    for member in range(2):
        unit = torch.zeros(2, dtype=torch.float64)
        unit[member] = 1.0
        wanted = difference(lambda by, unit=unit: end(sound.detach() + by * unit), 1e-5)
        assert float(found[member]) == pytest.approx(wanted, rel=1e-4)


@pytest.fixture(scope="module")
def ventricle():
    recording = geometry.Ventricle().recording(np.arange(0.0, 0.4401, 0.01), grid_spacing=3e-3, wall_spacing=3e-3)
    return recording, Scene.from_recording(recording, 3e-3)


def filled(ventricle, scheme, field, *, differentiable=False, dtype=torch.float64):
    """A sum over the nodes of a forecast by 20 ms of the filling of a ventricle, each with its own weight."""
    recording, scene = ventricle
    run = Simulator(scene, scheme, dtype=dtype, differentiable=differentiable).start(0.30, seed=3)
    run.impose(recording.grid, field, torch.from_numpy(np.array(recording.mask[30])))
    run.advance(0.32)
    inside = torch.from_numpy(np.array(recording.mask[30] & recording.mask[32]))
    value = run.fetch(recording.grid, inside).value[0]
    return (torch.where(inside, value, torch.zeros_like(value)) * draw(value.shape, 5)).sum(), run


@pytest.mark.parametrize("name", ["default", pytest.param("weakly_compressible", marks=pytest.mark.slow)])
def test_of_a_forecast_by_20_ms_with_moving_walls_and_an_open_valve(ventricle, name):
    scheme = preset(name)
    if name == "default":
        scheme = dataclasses.replace(scheme, **TIGHT)
    start = torch.from_numpy(ventricle[0].velocity[30]).double()
    direction = 0.1 * draw(start.shape, 1)
    field = start.clone().requires_grad_()
    end, run = filled(ventricle, scheme, field, differentiable=True)
    (found,) = torch.autograd.grad(end, field)
    wanted = difference(lambda by: filled(ventricle, scheme, start + by * direction)[0], 1e-3)
    assert float((found * direction).sum()) == pytest.approx(wanted, rel=1e-3)
    assert int(run.record.inserted.sum()) > 0 and not bool(run.record.failed.any())


def test_in_the_flux_that_a_valve_is_given():
    radius = 0.01
    grid = geometry.Grid.covering((-0.011, -0.011, 0), (0.011, 0.011, 0.03), 1e-3)
    points = grid.nodes()
    profile = (1 - points[:, :2].square().sum(1) / radius**2).clamp_min(0.0)
    velocity = torch.zeros((3, grid.size), dtype=torch.float64)
    velocity[2] = 0.6 * profile
    always = ((-1.0, 1.0),)
    valves = (Valve(1, always, flux=9e-5), Valve(2, always))
    walls = geometry.WallMotion.at_rest(geometry.tube(radius, 0.03, 2e-3))
    scheme = dataclasses.replace(preset("default"), **TIGHT)

    def end(factor, differentiable=False):
        scene = Scene(3e-3, walls=walls, valves=valves)
        run = Simulator(scene, scheme, dtype=torch.float64, differentiable=differentiable).start(0.0, seed=0)
        run.change(valve_strength=factor)
        run.impose(grid, velocity.reshape(3, *grid.shape), (profile > 0).reshape(grid.shape))
        run.advance(0.004)
        inside = run.particles.inside
        return run.particles.velocity[inside, 2].mean()

    factor = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(end(factor, True), factor)
    wanted = difference(lambda by: end(torch.tensor(1.0 + by, dtype=torch.float64)), 1e-5)
    assert float(found) == pytest.approx(wanted, rel=1e-3) and abs(wanted) > 0.05


@pytest.mark.parametrize("name", SCHEMES)
def test_in_the_place_of_the_walls(ventricle, name):
    """All of the wall and its upper part alone, from walls .1 mm outward: nodes that lie on them jump otherwise."""
    recording, scene = ventricle
    scheme = dataclasses.replace(preset(name), **TIGHT) if name == "default" else preset(name)
    height = scene.walls.vertices_at_keys[0][:, 2]
    shapes = np.stack([np.ones(len(height)), (height - height.min()) / np.ptp(height)])
    start = torch.tensor([1e-4, 5e-5], dtype=torch.float64)

    def end(amount, differentiable=False):
        run = Simulator(scene, scheme, dtype=torch.float64, differentiable=differentiable).start(0.30, seed=3)
        run.displace_walls(amount, shapes)
        run.impose(recording.grid, torch.from_numpy(recording.velocity[30]), torch.from_numpy(recording.mask[30]))
        run.advance(0.305)
        value = run.fetch(recording.grid, torch.from_numpy(recording.mask[30])).value[0]
        return (value.nan_to_num() * draw(value.shape, 5)).sum()

    amount = start.clone().requires_grad_()
    (found,) = torch.autograd.grad(end(amount, True), amount)
    for number, unit in enumerate(torch.eye(2, dtype=torch.float64)):
        wanted = difference(lambda by, unit=unit: end(start + by * unit), 1e-8)
        assert float(found[number]) == pytest.approx(wanted, rel=1e-4)


def test_a_run_that_can_be_differentiated_has_the_bits_of_one_that_cannot(ventricle):
    field = torch.from_numpy(ventricle[0].velocity[30])
    plain = filled(ventricle, preset("default"), field, dtype=torch.float32)[1]
    for start in (field, field.clone().requires_grad_()):
        run = filled(ventricle, preset("default"), start, differentiable=True, dtype=torch.float32)[1]
        assert torch.equal(run.particles.velocity, plain.particles.velocity)
        assert torch.equal(run.particles.position, plain.particles.position)
        accounts = (repr(each.record.summary()) for each in (run, plain))
        assert len(set(accounts)) == 1


def test_the_tape_keeps_a_step_in_few_bytes_a_particle():
    kept = []

    def pack(tensor):
        kept.append(tensor.numel() * tensor.element_size())
        return tensor

    velocity = draw((256, 2), 2).requires_grad_()
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        _, run = stirred(SCHEMES["default"], velocity, 0.05)
    steps = int(run.record.steps)
    assert steps > 10 and sum(kept) / (256 * steps) < 300


def test_gradients_that_nobody_prepared_for_are_refused_with_the_cure():
    with pytest.raises(ValueError, match="Simulator with differentiable=True"):
        stirred(SCHEMES["default"], draw((256, 2), 2).requires_grad_(), differentiable=False)


@pytest.mark.slow
def test_viscosity_and_flux_are_found_from_a_noisy_measurement():
    """``examples/fit_viscosity_and_flux.py``: both start a factor of two off; noise as large as a sixth of the flow."""
    path = Path(__file__).parents[3] / "examples" / "fit_viscosity_and_flux.py"
    example = runpy.run_path(str(path))
    viscosity, flux = example["fitted"](0.05, 2).tolist()
    assert viscosity == pytest.approx(1.0, abs=0.1) and flux == pytest.approx(1.0, abs=0.03)
