"""The stepping: order of algorithm 1, batch = single, conservation, viscous decay, failures frozen and counted."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import geometry
from torchsph import Scene, Simulator, WeaklyCompressible, preset
from torchsph.simulator.scene import Fluid, Valve
from torchsph.simulator.schemes.wall_models import PotentialWall
from torchsph.simulator.state.particles import Particles

PERIODIC = Scene(spacing=1 / 24, fluid=Fluid(1.0, 0.02), period=(1.0, 1.0), reference_speed=1.0, dimension=2)


def taylor_green(position):
    x, y = (2 * math.pi * position).unbind(1)
    return torch.stack([-torch.cos(x) * torch.sin(y), torch.sin(x) * torch.cos(y)], 1)


def started(scene=PERIODIC, members=1, dtype=torch.float64, speeds=(1.0,), seed=0, **changes):
    """A Taylor-Green vortex (Taylor & Green 1937); member b is ``speeds[b]`` times as fast."""
    options = {"sound_speed": 10.0, "bulk_damping": None, "artificial_viscosity": None} | changes
    run = Simulator(scene, WeaklyCompressible(**options), dtype=dtype).start(0.0, members=members, seed=seed)
    factor = torch.tensor(speeds, dtype=dtype)[run.particles.member]
    field = taylor_green(run.particles.position * scene.spacing) * factor[:, None]
    run.particles = run.particles.changed(velocity=field / run.units.speed)
    return run


def kinetic_energy(run):
    p = run.particles
    return float((p.mass * p.velocity.square().sum(1)).sum() / p.mass.sum()) * run.units.speed**2 / 2


def one_particle(distance, steps):
    """One particle in the potential of a flat wall, at rest at ``distance`` spacings; ``steps`` to the end."""
    box = geometry.box((0, 0, 0), (0.04, 0.04, 0.04), 0.01)
    scene = Scene(spacing=1e-3, walls=geometry.WallMotion.at_rest(box))
    scheme = preset("thesis", wall=PotentialWall(0.2, 1.0, None), steps_per_frame=steps, background_pressure=0.0)
    run = Simulator(scene, scheme, dtype=torch.float64)
    place = torch.tensor([[20.0, 20.0, distance]], dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    label = torch.zeros(1, dtype=torch.int64)
    return run, Particles(place, torch.zeros_like(place), 0 * one, one, label, label, 1)


def test_leap_frog_of_algorithm_1_is_second_order_for_position_forces():
    """In the potential the particle swings as d = 1 - (1 - d0) cos(w t), w^2 = stiffness c^2 (internal units).

    The positions of algorithm 1 belong to half steps: q^(-1/2) = q(-dt/2) is what the scheme starts from.
    """
    omega, depth = math.sqrt(0.2) * 5.0, 0.5
    duration = 0.3 / omega
    errors = []
    for steps in (16, 32, 64):
        dt = duration / steps
        simulator, particles = one_particle(1 - depth * math.cos(omega * dt / 2), steps)
        run = simulator.resume(particles, 0.0)
        run.advance(duration * run.units.time)
        expected = 1 - depth * math.cos(omega * (duration - dt / 2))
        errors.append(abs(float(run.particles.position[0, 2]) - expected))
    order = np.polyfit(np.log([16, 32, 64]), np.log(errors), 1)[0]
    assert -order == pytest.approx(2.0, abs=0.1)


def test_a_batch_of_three_equals_three_single_runs():
    speeds = (1.0, 0.5, 0.8)
    batch = started(members=3, speeds=speeds, seed=4)
    batch.advance(0.03)
    for b, speed in enumerate(speeds):
        single = started(members=1, speeds=(speed,), seed=4)
        single.advance(0.03)
        mine = batch.particles.member == b
        torch.testing.assert_close(batch.particles.velocity[mine], single.particles.velocity, rtol=1e-9, atol=1e-11)
        assert int(batch.record.steps[b]) == int(single.record.steps[0])


def test_symmetric_forces_conserve_linear_and_angular_momentum():
    """Pressure 2.23 and artificial viscosity are central and pairwise: both momenta stand still at round-off."""
    from torchsph.pairs import MomentumTerms, PairState, Support, choose_backend
    from torchsph.pairs.smoothing_kernels import kernel

    generator = torch.Generator().manual_seed(0)
    x = 8 * torch.rand(600, 3, generator=generator, dtype=torch.float64)
    v = torch.randn(600, 3, generator=generator, dtype=torch.float64)
    mass = 0.5 + torch.rand(600, generator=generator, dtype=torch.float64)
    deviation = 0.05 * torch.randn(600, generator=generator, dtype=torch.float64)
    label = torch.zeros(600, dtype=torch.int64)
    state = PairState(x, v, mass, deviation, 10 * deviation, label)
    engine, support = choose_backend("reference"), Support(kernel("gaussian"), 0.84, 3)
    pairs = engine.search(x, label, support.radius)
    force = mass[:, None] * engine.momentum(pairs, state, support, MomentumTerms("symmetric", artificial=2.0))
    size = force.abs().sum()
    assert force.sum(0).abs().max() < 1e-13 * size
    assert torch.linalg.cross(x, force).sum(0).abs().max() < 1e-12 * size


def test_taylor_green_decays_at_the_viscous_rate():
    """Kinetic energy falls as exp(-16 pi^2 nu t) (exact solution of Navier-Stokes), within 4 % at 24^2."""
    run = started(dtype=torch.float32)
    before = kinetic_energy(run)
    run.advance(0.1)
    assert kinetic_energy(run) / before == pytest.approx(math.exp(-16 * math.pi**2 * 0.02 * 0.1), rel=0.04)
    assert int(run.record.failed.sum()) == 0
    # (v/c)^2 = 1 %; the start without pressure rings at about twice that
    assert 0.97 < float(run.record.smallest_density.min()) < float(run.record.largest_density.max()) < 1.03


def test_momentum_of_a_periodic_box_does_not_drift_in_the_conservative_form():
    run = started(pressure="sum", shifting=None)

    def momentum():
        return (run.particles.mass[:, None] * run.particles.velocity).sum(0)

    before = momentum()
    run.advance(0.05)
    assert (momentum() - before).abs().max() < 1e-11 * float(run.particles.mass.sum())


def test_a_background_pressure_changes_nothing_in_the_default_preset():
    fields = []
    for background in (0.0, 5.0):
        run = started(background_pressure=background)
        run.advance(0.02)
        fields.append(run.particles.velocity)
    assert torch.equal(*fields)


def test_the_limit_that_decides_is_named_and_counted():
    run = started()
    run.advance(0.01)
    limits = run.record.summary()["limited_by"]
    assert sum(counts[0] for counts in limits.values()) == int(run.record.steps[0])
    assert limits["acoustic"][0] > 0
    thick = started(scene=replace(PERIODIC, fluid=Fluid(1.0, 30.0)))
    thick.advance(0.0005)
    assert thick.record.summary()["limited_by"]["viscous"][0] > 0


def test_bad_scenes_and_options_are_refused():
    with pytest.raises(ValueError, match="Scene.spacing must be positive"):
        Scene(spacing=0.0)
    with pytest.raises(ValueError, match="a scene with valves needs walls"):
        Scene(spacing=1.0, valves=(Valve(1, ((0.0, 1.0),)),))
    with pytest.raises(ValueError, match="period of .* spacings is not a whole number"):
        Simulator(replace(PERIODIC, spacing=0.037)).start(0.0)
    with pytest.raises(ValueError, match="unknown preset 'best'; known: default, projection, thesis"):
        preset("best")
    with pytest.raises(ValueError, match="WeaklyCompressible.pressure must be one of"):
        WeaklyCompressible(pressure="odd")
    with pytest.raises(ValueError, match="unknown backend 'fast'"):
        Simulator(PERIODIC, backend="fast")
    with pytest.raises(ValueError, match="cannot advance backwards"):
        started().advance(-1.0)
    with pytest.raises(ValueError, match="at least one member"):
        Simulator(PERIODIC).start(0.0, members=0)
