"""The incompressible scheme: fields without divergence, momentum, pressure at rest, precisions, what goes wrong."""

import math

import numpy as np
import pytest
import torch

import geometry
from torchsph import NumericalFailure, Projection, Scene, Simulator, WeaklyCompressible
from torchsph.pairs.interface import RateTerms
from torchsph.simulator.scene import Fluid, Valve
from torchsph.simulator.state.particles import RESERVOIR, Particles
from torchsph.simulator.state.record import LIMITS
from torchsph.simulator.stepping.pressure import Neighbourhood

SIDE = 24
SCHEME = Projection()
PERIODIC = Scene(spacing=1 / SIDE, fluid=Fluid(1.0, 0.01), period=(1.0, 1.0), dimension=2)


def particles(velocity, members=1, disorder=0.05, dtype=torch.float64):
    """A slightly disordered square of particles with the velocity field ``velocity(x, y)``, x and y in radians."""
    generator = torch.Generator().manual_seed(2)
    axis = torch.arange(SIDE, dtype=torch.float64) + 0.5
    place = torch.cartesian_prod(axis, axis)
    place = place + disorder * (2 * torch.rand(place.shape, generator=generator, dtype=torch.float64) - 1)
    x, y = (2 * math.pi * place / SIDE).unbind(1)
    ones, label = torch.ones_like(x), torch.zeros(len(x), dtype=torch.int64)
    arrays = [place, torch.stack(velocity(x, y), 1), 0 * ones, ones]
    return Particles(*(a.to(dtype) for a in arrays), label, label, 1).repeated(members)


def vortex(x, y):
    return -torch.cos(x) * torch.sin(y), torch.sin(x) * torch.cos(y)


def slope(x, y):
    """The gradient of -cos x cos y: all divergence, no rotation."""
    return torch.sin(x) * torch.cos(y), torch.cos(x) * torch.sin(y)


def divergence(run):
    """RMS of the pair sums' velocity divergence over that of the velocity gradient of the vortex (2 pi per side)."""
    p, stepper = run.particles, run._stepper
    around = Neighbourhood(p, stepper.pair_search, stepper.pair_search.at(p), stepper.support, None)
    gradient = 2 * math.pi / SIDE
    return float(around.rates(RateTerms()).divergence.square().mean().sqrt()) / gradient


def test_projecting_takes_the_gradient_out_and_leaves_the_vortex():
    """Helmholtz: of a vortex plus a gradient field only the vortex stays."""
    run = Simulator(PERIODIC, SCHEME, dtype=torch.float64).resume(
        particles(lambda x, y: tuple(a + 0.5 * b for a, b in zip(vortex(x, y), slope(x, y), strict=True))), 0.0
    )
    wanted = particles(vortex).velocity
    before, divergent = float((run.particles.velocity - wanted).norm() / wanted.norm()), divergence(run)
    run.project(3)
    after = float((run.particles.velocity - wanted).norm() / wanted.norm())
    assert before > 0.45 and after < 0.02
    assert divergence(run) < 0.05 * divergent


@pytest.mark.parametrize("backend", ["reference", "auto"])
def test_the_equation_that_is_solved_is_solved(backend):
    """The residual in the projection's own operator, recomputed, is what the tolerance asks for."""
    scheme = Projection(tolerance=1e-4)
    run = Simulator(PERIODIC, scheme, dtype=torch.float64, backend=backend).resume(particles(slope), 0.0)
    p, stepper = run.particles, run._stepper
    around = Neighbourhood(p, stepper.pair_search, stepper.pair_search.at(p), stepper.support, None)
    source = -around.rates(RateTerms()).divergence
    _, found = around.project(source, None, None, 1e-4, 200)
    solved = stepper.pair_search.backend.laplacian(around.pairs, p.state(p.deviation), around.support, found.values)[0]
    left = solved - (source - source.mean())
    assert float(left.norm()) < 1.01e-4 * float(source.norm())
    assert bool(found.converged.all())


def test_a_valve_at_a_given_pressure_may_be_shut_at_the_start():
    """A box at rest whose valve opens later: until then the packing's own noise is all (measured 0.010 m/s)."""
    box = geometry.polygon(np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float), 1 / 16)
    region = (box.centroids[:, 0] < 1e-9).astype(np.uint8)
    walls = geometry.WallMotion.at_rest(geometry.Surface(box.vertices, box.faces, region))
    valve = Valve(1, ((0.05, 9.0),), pressure=1.0)
    scene = Scene(spacing=1 / 8, fluid=Fluid(1.0, 0.0), walls=walls, valves=(valve,), dimension=2)
    run = Simulator(scene, SCHEME, dtype=torch.float64).start(0.0)
    run.advance(0.04)
    assert float(run.particles.velocity.abs().max()) < 0.02
    run.advance(0.06)
    assert not bool(run.record.failed.any()) and int((run.particles.kind == RESERVOIR).sum()) > 0


def test_a_vortex_decays_as_it_should_and_keeps_its_momentum():
    """Taylor-Green at Re 100: velocity within 6 % of the exact one at 24 across, linear momentum at round-off."""
    run = Simulator(PERIODIC, SCHEME, dtype=torch.float64).resume(particles(vortex, disorder=0.02), 0.0)
    momentum = (run.particles.mass[:, None] * run.particles.velocity).sum(0)
    run.advance(0.5)
    p = run.particles
    x, y = (2 * math.pi * p.position / SIDE).unbind(1)
    exact = math.exp(-8 * math.pi**2 * 0.01 * 0.5) * torch.stack(vortex(x, y), 1)
    assert float((p.velocity - exact).norm() / exact.norm()) < 0.06
    torch.testing.assert_close((p.mass[:, None] * p.velocity).sum(0), momentum, rtol=0, atol=1e-9)
    assert int(run.record.unconverged) == 0 and float(divergence(run)) < 0.05


def test_single_precision_follows_double():
    """Twenty steps with a tight solver: the same field within a thousandth (issue of float32 in small scenes)."""
    fields = []
    for dtype in (torch.float32, torch.float64):
        scheme = Projection(tolerance=1e-5, max_step=2e-3)
        run = Simulator(PERIODIC, scheme, dtype=dtype).resume(particles(vortex, dtype=dtype), 0.0)
        run.advance(0.04)
        assert int(run.record.steps) >= 20
        fields.append(run.particles.velocity.double())
    assert float((fields[0] - fields[1]).norm() / fields[1].norm()) < 1e-3


def test_a_batch_is_its_members():
    """Members converge by themselves: two speeds in one batch move as alone."""
    both = particles(vortex, members=2)
    factor = torch.tensor([1.0, 0.3], dtype=torch.float64)[both.member][:, None]
    run = Simulator(PERIODIC, SCHEME, dtype=torch.float64).resume(both.changed(velocity=factor * both.velocity), 0.0)
    run.advance(0.05)
    for member, speed in enumerate((1.0, 0.3)):
        start = particles(vortex)
        slower = start.changed(velocity=speed * start.velocity)
        alone = Simulator(PERIODIC, SCHEME, dtype=torch.float64).resume(slower, 0.0)
        alone.advance(0.05)
        mine = run.particles.velocity[run.particles.member == member]
        torch.testing.assert_close(mine, alone.particles.velocity, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_full_box_under_gravity_bears_its_weight(dtype):
    """rho g (depth), up to the constant that a full box leaves open, on top of the pressure without gravity.

    What is left of the start, as particles settle at the walls, moves at less than .01 sqrt(g H).
    """
    box = geometry.polygon(np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float), 1 / 32)
    runs = []
    for gravity in ((0.0, -1.0), None):
        scene = Scene(
            spacing=1 / 16,
            fluid=Fluid(1000.0, 1e-2),
            walls=geometry.WallMotion.at_rest(box),
            gravity=gravity,
            dimension=2,
        )
        runs.append(Simulator(scene, Projection(max_step=5e-3), dtype=dtype).start(0.0))
        runs[-1].advance(0.01)
    heavy, light = (run.particles for run in runs)
    borne = ((heavy.pressure - light.pressure) * runs[0].units.speed ** 2).double()  # over the density
    height = heavy.position[:, 1].double() / 16
    torch.testing.assert_close(borne - borne.mean(), height.mean() - height, rtol=0, atol=1e-4)
    torch.testing.assert_close(heavy.velocity, light.velocity, rtol=0, atol=1e-5)
    runs[0].advance(0.5)
    p = runs[0].particles
    expected = height.mean() - p.position[:, 1].double() / 16
    pressure = p.pressure.double() * runs[0].units.speed ** 2
    assert float((pressure - pressure.mean() - expected).abs().max()) < 0.03
    assert float(p.velocity.norm(dim=1).max()) < 0.01


def test_a_closed_cavity_that_shrinks_is_reported_and_does_not_explode():
    """No pressure answers it: the mean divergence is taken out, shown in the record, and the flow stays slow."""
    ball = geometry.ellipsoid((6e-3, 6e-3, 6e-3), 1.5e-3)
    times = np.linspace(0.0, 0.02, 5)
    places = np.stack([ball.vertices * (1 - 2.0 * t) for t in times])
    walls = geometry.WallMotion.through(times, places, ball.faces, ball.region)
    run = Simulator(Scene(spacing=1.5e-3, walls=walls), Projection()).start(0.0)
    run.advance(0.02)
    rate = 3 * 2.0  # 1/s, of the volume
    assert float(run.record.largest_mismatch) * 1.0 / 1.5e-3 == pytest.approx(rate, rel=0.25)
    assert not bool(run.record.failed.any()) and int(run.record.outside.sum()) == 0
    speed = run.particles.velocity[run.particles.inside].norm(dim=1) * run.units.speed
    assert float(speed.max()) < 10 * 2.0 * 6e-3


@pytest.mark.parametrize("gap", [1.0, 6.0])
def test_a_cavity_split_in_two(gap):
    """Halves closer than a kernel, and so far apart that each has a constant of its own: nothing leaks, all converges.

    The right half is at rest and stays so where no kernel reaches across: what does reach across is the price of walls
    thinner than a kernel.
    """
    spacing = 1 / 16
    half = geometry.polygon(np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float), spacing / 2)
    shift = 1 + gap * spacing
    walls = geometry.Surface(
        np.concatenate([half.vertices, half.vertices + [shift, 0.0]]),
        np.concatenate([half.faces, half.faces + len(half.vertices)]),
    )
    scene = Scene(spacing=spacing, fluid=Fluid(1.0, 1e-3), walls=geometry.WallMotion.at_rest(walls), dimension=2)
    run = Simulator(scene, Projection(max_step=5e-3), dtype=torch.float64).start(0.0)
    p = run.particles
    x, y = (math.pi * p.position * spacing).unbind(1)
    left = p.position[:, 0] * spacing < 1 + 0.5 * gap * spacing
    swirl = torch.stack([torch.sin(x) * torch.cos(y), -torch.cos(x) * torch.sin(y)], 1)
    run = run.simulator.resume(p.changed(velocity=torch.where(left[:, None], swirl, 0.0 * swirl)), 0.0)
    run.advance(0.3)
    p = run.particles
    assert int(run.record.unconverged) == 0 and int(run.record.outside.sum()) == 0
    assert bool(((p.position[:, 0] * spacing < 1 + 0.5 * gap * spacing) == left).all())
    assert float(p.velocity[left].norm(dim=1).max()) > 0.5
    assert float(p.velocity[~left].norm(dim=1).max()) < (0.5 if gap < 2 else 0.05)


def test_a_step_of_5_ms_is_cut_to_what_the_flow_allows():
    """Asked for 5 ms in a scene of the heart's size and speed: limited by the flow, named in the record, no harm."""
    ball = geometry.WallMotion.at_rest(geometry.ellipsoid((8e-3, 8e-3, 8e-3), 1.5e-3))
    scene = Scene(spacing=1.5e-3, walls=ball)
    run = Simulator(scene, Projection(max_step=5e-3)).start(0.0)
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(run.particles.velocity.shape, generator=generator)
    run = run.simulator.resume(run.particles.changed(velocity=noise), 0.0)
    energy = float(noise.square().sum())
    run.advance(0.02)
    assert int(run.record.steps) > 10 and int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())
    assert float(run.particles.velocity.square().sum()) < energy
    limited = dict(zip(LIMITS, run.record.limited_by[0].tolist(), strict=True))
    assert limited["acoustic"] + limited["force"] > 0.8 * int(run.record.steps)


def test_white_noise_dies_out_and_a_lone_particle_drifts_on():
    generator = torch.Generator().manual_seed(4)
    start = particles(vortex)
    noise = torch.randn(start.velocity.shape, generator=generator, dtype=torch.float64)
    run = Simulator(PERIODIC, SCHEME, dtype=torch.float64).resume(start.changed(velocity=noise), 0.0)
    energy = [float(run.particles.velocity.square().sum())]
    for time in (0.02, 0.05, 0.1):
        run.advance(time)
        energy.append(float(run.particles.velocity.square().sum()))
    assert energy == sorted(energy, reverse=True) and energy[-1] < 0.5 * energy[0]
    open_space = Scene(spacing=1.0, fluid=Fluid(1.0, 0.0), dimension=2, period=(None, None))
    ones, label = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.int64)
    lone = Particles(ones[:, None].repeat(1, 2), ones[:, None].repeat(1, 2), 0 * ones, ones, label, label, 1)
    free = Simulator(open_space, Projection(surface=0.85, max_step=None), dtype=torch.float64).resume(lone, 0.0)
    free.advance(1.0)
    torch.testing.assert_close(free.particles.position * 1.0, torch.full((1, 2), 2.0, dtype=torch.float64))


def test_a_member_with_nan_is_frozen_and_the_others_go_on():
    both = particles(vortex, members=2)
    spoilt = both.velocity.clone()
    spoilt[5] = float("nan")
    run = Simulator(PERIODIC, SCHEME, dtype=torch.float64).resume(both.changed(velocity=spoilt), 0.0)
    run.advance(0.02)
    assert run.record.failed.tolist() == [True, False]
    assert bool(torch.isfinite(run.particles.velocity[run.particles.member == 1]).all())
    alone = Simulator(PERIODIC, SCHEME, dtype=torch.float64).resume(particles(vortex), 0.0)
    alone.particles = alone.particles.changed(velocity=spoilt[: SIDE**2])
    with pytest.raises(NumericalFailure, match="all 1 members have failed"):
        alone.advance(0.02)


@pytest.mark.parametrize("scheme", [SCHEME, WeaklyCompressible()])
def test_a_member_that_is_too_fast_for_any_step_is_frozen(scheme):
    """1e30 m/s would take a step of next to nothing, for ever."""
    both = particles(vortex, members=2, dtype=torch.float32)
    wild = both.velocity.clone()
    wild[7] = 1e30
    run = Simulator(PERIODIC, scheme).resume(both.changed(velocity=wild), 0.0)
    run.advance(0.01)
    assert run.record.failed.tolist() == [True, False]


def test_a_free_surface_has_to_be_named():
    start = particles(vortex)
    half = start.select(start.position[:, 0] < SIDE / 2)
    with pytest.raises(ValueError, match=r"fill 50 % of what encloses them.*surface=0.85"):
        Simulator(PERIODIC, SCHEME, dtype=torch.float64).resume(half, 0.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 0.0}, "tolerance must be positive"),
        ({"relaxation": -1.0}, "relaxation must be positive or None"),
        ({"iterations": 0}, "at least one iteration"),
        ({"surface": 1.5}, "surface must lie in"),
        ({"wall": None}, "wall must be a CompleteKernelWall"),
        ({"shifting_speed": "mean"}, "shifting_speed must be"),
    ],
)
def test_options_that_cannot_be(options, message):
    with pytest.raises(ValueError, match=message):
        Projection(**options)
