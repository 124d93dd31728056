"""What holds for valves of every model that is registered: a new one is tested here without a line."""

import numpy as np
import pytest
import torch

import geometry
from torchsph import Scene, Simulator, preset
from torchsph.simulator.valves.registry import registered_models

VENTRICLE = geometry.Ventricle()
SPACING = 3e-3
SHUT = (0.235, 0.245)  # s, both valves of the ventricle are
FILLING = (0.290, 0.297)
TURN = (0.195, 0.285)  # the end of ejection, both valves shut, the beginning of filling


@pytest.fixture(scope="module")
def scene():
    times = np.arange(0.0, 0.4401, 0.01)
    return Scene.from_recording(VENTRICLE.recording(times, grid_spacing=3e-3, wall_spacing=3e-3), SPACING)


@pytest.fixture(params=registered_models(), ids=lambda kind: kind.__name__)
def model(request):
    """Options of one model as they come."""
    return request.param()


def simulator(scene, model):
    return Simulator(scene, preset("weakly_compressible", valve=model))


def state(run, member=0):
    mine = run.particles.member == member
    return [getattr(run.particles, name)[mine] for name in ("position", "velocity", "deviation")]


def test_a_shut_valve_is_a_wall(scene, model):
    """Bit for bit what happens without valves, and nothing is entered in the accounts."""
    with_valves = simulator(scene, model).start(SHUT[0], seed=0)
    without = Simulator(
        Scene(SPACING, scene.fluid, walls=scene.walls, dimension=3), preset("weakly_compressible", valve=None)
    ).start(SHUT[0], seed=0)
    for run in (with_valves, without):
        run.advance(SHUT[1])
    for mine, theirs in zip(state(with_valves), state(without), strict=True):
        assert torch.equal(mine, theirs)
    record = with_valves.record
    assert not bool(record.inflow.any()) and not bool(record.outflow.any())


def test_what_is_in_the_cavity_is_what_was_there_and_what_passed(scene, model):
    run = simulator(scene, model).start(TURN[0], seed=0)
    before, volume = int(run.particles.inside.sum()), float(run.particles.mass[run.particles.inside].sum())
    run.advance(TURN[1])
    record, p = run.record, run.particles
    assert not bool(record.failed.any())
    assert int(p.inside.sum()) == before + int(record.inserted.sum()) - int(record.removed.sum())
    passed = float((record.inflow - record.outflow).sum()) / SPACING**3
    assert float(p.mass[p.inside].sum()) == pytest.approx(volume + passed, rel=1e-5)


def test_a_cavity_that_grows_draws_blood_in(scene, model):
    """In the half below the openings the mean velocity points inwards."""
    run = simulator(scene, model).start(FILLING[0], seed=0)
    run.advance(FILLING[1])
    p = run.particles
    upper = p.inside & (p.position[:, 2] * SPACING > -8e-3)
    assert int(upper.sum()) > 20
    assert float((p.velocity[upper, 2] * run.units.speed).mean()) < -0.01


def test_a_member_has_the_bits_it_has_alone(scene, model):
    """Members whose particles stand elsewhere let blood through at other moments."""
    both = simulator(scene, model).start(FILLING[0], members=2, seed=0)
    shift = torch.zeros_like(both.particles.velocity)
    shift[both.particles.member == 1] = torch.tensor([0.0, 0.0, -0.2]) / both.units.speed
    both.particles = both.particles.changed(velocity=both.particles.velocity + shift)
    alone = simulator(scene, model).resume(one(both.particles, 1), FILLING[0])
    for run in (both, alone):
        run.advance(FILLING[1])
    for mine, theirs in zip(state(both, 1), state(alone), strict=True):
        assert torch.equal(mine, theirs)


def one(particles, member):
    """The particles of one member as a set of its own."""
    mine = particles.select(particles.member == member)
    return type(mine)(mine.position, mine.velocity, mine.deviation, mine.mass, mine.member * 0, mine.kind, 1)


def test_an_incompressible_scheme_takes_it_or_says_why_not(scene, model):
    if model.needs_compressible:
        with pytest.raises(ValueError, match=type(model).__name__):
            preset("default", valve=model)
    else:
        run = Simulator(scene, preset("default", valve=model)).start(SHUT[0], seed=0)
        run.advance(SHUT[0] + 1e-3)
        assert not bool(run.record.failed.any())
