"""What holds for walls of every model that is registered: a new one is tested here without a line."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from wall_cases import assert_nothing_went_wrong

import geometry
from torchsph import Scene, Simulator, preset
from torchsph.simulator.scene import Fluid
from torchsph.simulator.state.particles import FLUID, Particles
from torchsph.simulator.walls.interface import CompleteWallSample, FluidAtWalls, WallSample
from torchsph.simulator.walls.registry import registered_models, wall_forces
from torchsph.validation.exact_flows import FREE_SURFACE_OPTIONS

ACROSS, GRAVITY, COUNT = 12, 1.0, 40
SOUND, VISCOSITY = 3.0, 0.2


@pytest.fixture(params=registered_models(), ids=lambda kind: kind.__name__)
def model(request):
    """Options of one model as they come."""
    return request.param()


def tank(model, backend="auto"):
    """A closed box, 2 m high, in which a column 1 m wide has half a spacing more than it needs at each side."""
    gap = 0.5 / ACROSS
    corners = np.array([[-gap, -gap], [1 + gap, -gap], [1 + gap, 2], [-gap, 2]], float)
    scene = Scene(
        spacing=1 / ACROSS,
        fluid=Fluid(1000.0, 0.0),
        walls=geometry.WallMotion.at_rest(geometry.polygon(corners, gap)),
        dimension=2,
        gravity=(0.0, -GRAVITY),
        reference_speed=1.0,
    )
    scheme = preset("weakly_compressible", **(FREE_SURFACE_OPTIONS | {"wall": model}))
    return Simulator(scene, scheme, dtype=torch.float64, backend=backend)


def column(members=1):
    """A square of fluid at rest on the tank's floor, its density in balance with gravity."""
    axis = torch.arange(ACROSS, dtype=torch.float64) + 0.5
    place = torch.cartesian_prod(axis, axis)
    label, ones = torch.zeros(len(place), dtype=torch.int64), torch.ones(len(place), dtype=torch.float64)
    weight = GRAVITY * (1 - place[:, 1] / ACROSS) / FREE_SURFACE_OPTIONS["sound_speed"] ** 2
    return Particles(place, 0 * place, weight, ones, label, label + FLUID, 1).repeated(members)


def energy(run):
    """Kinetic energy and that of the height, per mass, m^2/s^2."""
    p = run.particles
    return float(p.velocity.square().sum(1).mean()) / 2 + GRAVITY * float(p.position[:, 1].mean()) / ACROSS


def test_a_resting_column_stays_in_its_tank(model):
    """Half a second, in which sound crosses it five times and a free fall comes to 0.5 m/s: nothing leaks.

    It sinks by no more than the half spacing that the tank leaves it at its floor and sides, and comes to rest there.
    """
    run = tank(model).resume(column(), 0.0)
    run.advance(0.5)
    assert_nothing_went_wrong(run)
    assert float(run.particles.velocity.square().sum(1).mean().sqrt()) < 0.1
    assert -1.5 < float(run.particles.position[:, 1].mean()) - ACROSS / 2 < 0.1


def test_a_drop_thrown_at_a_wall_gains_no_energy(model):
    """A square at 1 m/s against the floor: at no time more kinetic energy and height than it came with, within 1 %."""
    start = column()
    start = start.changed(
        position=start.position + torch.tensor([0.0, 4.0], dtype=torch.float64),
        velocity=torch.tensor([[0.0, -1.0]], dtype=torch.float64).repeat(start.count, 1),
        deviation=torch.zeros_like(start.deviation),
    )
    run = tank(model).resume(start, 0.0)
    levels = [energy(run)]
    for step in range(1, 21):
        run.advance(0.04 * step)
        levels.append(energy(run))
    assert_nothing_went_wrong(run)
    assert float(run.particles.position[:, 1].min()) < 2.0  # it did arrive
    assert max(levels) < 1.01 * levels[0]


def test_members_do_not_feel_each_other(model):
    """Two columns of which one is thrown: each moves as alone."""
    both = column(2)
    thrown = torch.tensor([0.0, 0.5], dtype=torch.float64)[both.member]
    both = both.changed(velocity=torch.stack([thrown, thrown], 1))
    together = tank(model, "reference").resume(both, 0.0)
    together.advance(0.05)
    for member in (0, 1):
        mine = both.member == member
        start = replace(both.select(mine), member=torch.zeros_like(both.member[mine]), members=1)
        alone = tank(model, "reference").resume(start, 0.0)
        alone.advance(0.05)
        mine = together.particles.member == member
        torch.testing.assert_close(together.particles.position[mine], alone.particles.position, rtol=0, atol=1e-10)


def seen(model, generator, velocity):
    """Plane walls as this model asks for them, from well behind to well before, moving with ``velocity`` (N, D)."""
    distance = 4 * torch.rand(COUNT, generator=generator, dtype=torch.float64) - 1
    normal = torch.nn.functional.normalize(torch.randn((COUNT, 3), generator=generator, dtype=torch.float64), dim=1)
    if not model.complete:
        return WallSample(distance, normal, velocity)
    completeness = (0.5 + 0.3 * distance).clamp(0.0, 1.0)
    steep = torch.where((completeness > 0) & (completeness < 1), 0.3, 0.0).double()
    return CompleteWallSample(distance, normal, velocity, completeness, steep[:, None] * normal)


def fluid(velocity, generator):
    deviation = 0.02 * torch.randn(COUNT, generator=generator, dtype=torch.float64)
    member = torch.arange(COUNT) % 2
    return FluidAtWalls(velocity, deviation, member, "sum", SOUND**2 * deviation, SOUND, VISCOSITY)


def random_vectors(seed):
    return torch.randn((COUNT, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_only_velocities_relative_to_the_wall_count(model):
    """Fluid and wall set going together: the same forces, friction and divergence, for particles behind it too."""
    forces, own, walls = wall_forces(model), random_vectors(1), random_vectors(2)
    common, pairs = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64), random_vectors(3)
    dt, divergence = torch.full((COUNT,), 0.01, dtype=torch.float64), random_vectors(4)[:, 0]
    results = []
    for shift in (0 * common, common):
        generator = torch.Generator().manual_seed(5)
        wall = seen(model, generator, walls + shift)
        there = fluid(own + shift, generator)
        results.append(
            (
                forces.accelerate(pairs, there, wall),
                forces.damp(there, wall, dt) - shift,
                forces.complete_rates(divergence, pairs, there.velocity, wall)[0],
            )
        )
    for still, moving in zip(*results, strict=True):
        assert bool(torch.isfinite(still).all())
        torch.testing.assert_close(still, moving)


def test_walls_at_rest_do_no_work(model):
    generator = torch.Generator().manual_seed(6)
    wall = seen(model, generator, torch.zeros((COUNT, 3), dtype=torch.float64))
    dt = torch.full((COUNT,), 0.01, dtype=torch.float64)
    power = wall_forces(model).power(random_vectors(7), fluid(random_vectors(8), generator), wall, dt)
    torch.testing.assert_close(power, torch.zeros_like(power))


def test_far_from_walls_nothing_is_felt(model):
    """Three spacings off, with the whole kernel in the fluid."""
    generator = torch.Generator().manual_seed(9)
    wall = seen(model, generator, random_vectors(10))
    wall = replace(wall, distance=torch.full_like(wall.distance, 3.0))
    if model.complete:
        whole = torch.ones_like(wall.distance)
        wall = replace(wall, completeness=whole, completeness_gradient=torch.zeros_like(wall.normal))
    there, pairs, forces = fluid(random_vectors(11), generator), random_vectors(12), wall_forces(model)
    torch.testing.assert_close(forces.accelerate(pairs, there, wall), pairs)
    torch.testing.assert_close(forces.damp(there, wall, torch.ones_like(wall.distance)), there.velocity)


def test_walls_of_an_unknown_model_are_refused():
    with pytest.raises(TypeError, match="no forces are registered for walls of type dict; known: CompleteKernelWall"):
        wall_forces({})
