"""States that break simulators: tensile instability, disorder, crowds, noise, vacuum, too long steps, tiny lengths."""

import math

import numpy as np
import pytest
import torch

import geometry
from torchsph import NumericalFailure, Rollback, Scene, Simulator, WeaklyCompressible
from torchsph.simulator.scene import Fluid
from torchsph.simulator.state.particles import Particles
from torchsph.simulator.state.record import LIMITS
from torchsph.validation.exact_flows import FREE_SURFACE_OPTIONS

PRECISIONS = [torch.float32, torch.float64]
BACKENDS = ["auto", "reference"]
OPEN = Scene(spacing=0.02, fluid=Fluid(1000.0, 1.0), reference_speed=1.0, dimension=2)
PERIODIC = Scene(spacing=1 / 20, fluid=Fluid(1.0, 0.01), period=(1.0, 1.0), reference_speed=1.0, dimension=2)


def particles_at(position, velocity, deviation=None):
    one = torch.ones_like(position[:, 0])
    label = torch.zeros(len(position), dtype=torch.int64)
    return Particles(position, velocity, 0 * one if deviation is None else deviation, one, label, label, 1)


def lattice(count, dtype):
    axis = torch.arange(count, dtype=dtype) + 0.5
    return torch.cartesian_prod(axis, axis)


def resumed(scene, particles, backend="auto", **changes):
    options = {"sound_speed": 10.0} | changes
    scheme = WeaklyCompressible(**options)
    simulator = Simulator(scene, scheme, dtype=particles.position.dtype, backend=backend)
    return simulator.resume(particles, 0.0)


def taylor_green(position, side=20):
    """Velocities (N, D) of the vortex of Taylor & Green 1937 in a period of ``side`` spacings, at unit speed."""
    x, y = (2 * math.pi * position / side).unbind(1)
    return torch.stack([-torch.cos(x) * torch.sin(y), torch.sin(x) * torch.cos(y)], 1)


def energies(run, until, parts=5):
    """Kinetic energy now and at the ends of equal parts of the time to come."""
    start, found = run.time, [energy(run)]
    for k in range(1, parts + 1):
        run.advance(start + k * (until - start) / parts)
        found.append(energy(run))
    return found


def falling(values):
    return all(late < early for early, late in zip(values, values[1:], strict=False))


def energy(run):
    return float((run.particles.mass * run.particles.velocity.square().sum(1)).sum()) / 2


def healthy(run):
    return not bool(run.record.failed.any()) and bool(torch.isfinite(run.particles.position).all())


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_rotating_square_patch_keeps_its_density(dtype, backend):
    """Colagrossi 2005: negative pressure inside tears untreated SPH apart; here until half a radian."""
    count, omega = 16, 2.0
    scene = OPEN
    position = lattice(count, dtype)
    arm = (position - count / 2) * scene.spacing
    velocity = omega * torch.stack([arm[:, 1], -arm[:, 0]], 1)
    run = resumed(scene, particles_at(position, velocity), backend, **FREE_SURFACE_OPTIONS)
    before = energy(run)
    run.advance(0.5 / omega)
    assert healthy(run)
    assert 0.99 < float(run.record.smallest_density) <= float(run.record.largest_density) < 1.01
    assert 0.9 * before < energy(run) <= before
    nearest = torch.cdist(run.particles.position, run.particles.position).fill_diagonal_(math.inf).amin(1)
    assert float(nearest.min()) > 0.7 and float(nearest.max()) < 1.2  # neither clumps nor strays


def test_the_switched_pressure_is_not_for_free_surfaces():
    """What the options for free surfaces are for: the default's pressure form feeds energy into the patch."""
    position = lattice(16, torch.float64)
    arm = (position - 8) * OPEN.spacing
    start = particles_at(position, 2.0 * torch.stack([arm[:, 1], -arm[:, 0]], 1))
    run = resumed(OPEN, start, **(FREE_SURFACE_OPTIONS | {"pressure": "switched"}))
    before = energy(run)
    run.advance(0.25)
    assert energy(run) > 10 * before


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("order", ["symplectic", "verlet", "predictor_corrector"])
def test_two_particles_at_one_place_stay_finite(dtype, backend, order):
    position = torch.cat([lattice(12, dtype), torch.full((1, 2), 6.5, dtype=dtype)])
    generator = torch.Generator().manual_seed(0)
    velocity = 0.1 * torch.randn(position.shape, generator=generator, dtype=dtype)
    run = resumed(OPEN, particles_at(position, velocity), backend, order=order)
    before = energy(run)
    run.advance(0.01)
    assert healthy(run) and energy(run) < 2 * before


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_single_particle_flies_straight_and_falls(dtype, backend):
    scene = Scene(spacing=0.02, gravity=(0.0, -9.81), dimension=2)
    start = particles_at(torch.zeros(1, 2, dtype=dtype), torch.tensor([[1.0, 0.0]], dtype=dtype))
    run = resumed(scene, start, backend, order="verlet")
    run.advance(0.1)
    expected = torch.tensor([0.1, -0.5 * 9.81 * 0.01], dtype=torch.float64)
    torch.testing.assert_close(run.particles.position[0].double() * 0.02, expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_front_that_leaves_a_vacuum_behind(dtype, backend):
    """Half of a block flies away: a gap opens, momentum stands still, energy only falls."""
    position = lattice(14, dtype)
    right = position[:, 0] > 7
    velocity = torch.zeros_like(position)
    velocity[right, 0] = 2.0
    run = resumed(OPEN, particles_at(position, velocity), backend, **FREE_SURFACE_OPTIONS)
    before = energy(run)
    run.advance(0.15)
    p = run.particles
    assert healthy(run) and energy(run) < before
    assert float(p.position[right, 0].min() - p.position[~right, 0].max()) > 2.0  # spacings; they start one apart
    assert float(p.velocity[right, 0].mean()) > 1.5
    drift = p.velocity[:, 0].mean() - 1.0
    assert abs(float(drift)) < (1e-5 if dtype == torch.float32 else 1e-12)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("speed", [0.5, 3.0])
def test_zero_viscosity_and_mach_0_3(dtype, backend, speed):
    """An inviscid vortex at Mach 0.05 and 0.3: no failure, no gain of energy."""
    scene = Scene(spacing=1 / 20, fluid=Fluid(1.0, 0.0), period=(1.0, 1.0), reference_speed=speed, dimension=2)
    position = lattice(20, dtype)
    run = resumed(scene, particles_at(position, taylor_green(position)), backend)
    before = energy(run)
    run.advance(0.1 / speed)
    assert healthy(run) and energy(run) < 1.01 * before
    assert float(run.record.largest_mach) == pytest.approx(speed / 10, rel=0.15)


def vortex(courant, dtype=torch.float32, backend="auto"):
    position = lattice(20, dtype)
    return resumed(PERIODIC, particles_at(position, taylor_green(position)), backend, courant=courant)


def test_steps_never_exceed_the_limits_whatever_the_frames_ask_for():
    """One step per frame is asked for; the acoustic limit courant h / (c + v) decides, and is counted as such."""
    run = vortex(0.35)
    run.advance(0.1)
    limit = 0.35 * 1.3 / 20 / 10
    assert int(run.record.steps) >= math.ceil(0.1 / limit)
    assert int(run.record.limited_by[0, LIMITS.index("acoustic")]) > 0.9 * int(run.record.steps)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("courant", [0.35, 1.05])
def test_steps_at_and_three_times_above_the_limit(courant, backend, dtype):
    """At the limit the vortex decays; three times above it the run is either sound or flagged, never silently wrong."""
    run = vortex(courant, dtype, backend)
    before = energy(run)
    try:
        run.advance(0.1)
    except NumericalFailure:
        assert courant > 0.35 and bool(run.record.failed.all())
        return
    sound = healthy(run) and energy(run) < before and float(run.record.largest_density) < 1.1
    flagged = float(run.record.largest_density) > 1.1 or float(run.record.largest_mach) > 0.3
    assert sound if courant == 0.35 else sound or flagged


def test_a_runaway_particle_meets_the_floor_of_the_step():
    """A particle at Mach 1000 asks for steps a thousand times shorter: they are cut once, down to the floor."""
    run = vortex(0.35)
    velocity = run.particles.velocity.clone()
    velocity[0, 0] = 1e4
    lone = run.particles.changed(velocity=velocity).select(torch.arange(1))
    run = resumed(OPEN, lone, step_floor=0.1)
    run.advance(0.01)
    rest = 0.35 * 1.3 * 0.02 / 10
    assert int(run.record.steps) == math.ceil(0.01 / (0.1 * rest))
    assert int(run.record.floored) == int(run.record.steps) and int(run.record.reductions) == 0
    run.particles = run.particles.changed(velocity=0 * velocity[:1])
    run.advance(0.02)
    run.particles = run.particles.changed(velocity=velocity[:1])
    run.advance(0.03)
    assert int(run.record.reductions) == 1
    with pytest.raises(ValueError, match="step_floor must lie in"):
        WeaklyCompressible(step_floor=2.0)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("least", [None, 0.5])
def test_a_drop_in_free_flight_does_not_spin_out_of_hand(least, dtype):
    """Three particles a tenth of a spacing apart, under tension: without a least density they gain without end."""
    angle = 2 * math.pi * torch.arange(3, dtype=dtype) / 3
    position = 0.09 / math.sqrt(3) * torch.stack([angle.cos(), angle.sin()], 1)
    velocity = 3.0 * torch.stack([-angle.sin(), angle.cos()], 1)
    drop = particles_at(position, velocity, torch.full((3,), -0.3, dtype=dtype))
    water = Scene(spacing=0.02, fluid=Fluid(1000.0, 0.001), reference_speed=1.0, dimension=2)
    run = resumed(water, drop, **(FREE_SURFACE_OPTIONS | {"least_density": least}))
    before = energy(run)
    if least is None:
        run.advance(0.03)
        assert energy(run) > 1e4 * before
        return
    run.advance(0.1)
    assert healthy(run) and energy(run) < before
    assert float(run.particles.deviation.min()) == pytest.approx(-0.5)
    with pytest.raises(ValueError, match="least_density must lie in"):
        WeaklyCompressible(least_density=1.0)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_white_noise_imposed_at_the_level_of_a_measurement_relaxes(dtype, backend):
    """0.3 m/s on every node, as where tracking is bad: the energy falls from the start on and stays low."""
    scheme = WeaklyCompressible(sound_speed=10.0)
    run = Simulator(PERIODIC, scheme, dtype=dtype, backend=backend).start(0.0)
    grid = geometry.Grid((0.0, 0.0), (0.05, 0.05), (21, 21))
    noise = 0.3 * torch.randn((2, 21, 21), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    run.impose(grid, noise, torch.ones(21, 21, dtype=torch.bool))
    found = energies(run, 0.04)
    assert falling(found) and found[-1] < 0.45 * found[0]
    assert healthy(run) and 0.96 < float(run.record.smallest_density) < float(run.record.largest_density) < 1.04


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_disorder_with_neighbours_from_a_tenth_of_a_spacing_on(dtype, backend):
    """The vortex on random positions, nearest neighbours 0.1 to 1.15 spacings apart, decays as exp(-16 pi^2 nu t)."""
    generator = torch.Generator().manual_seed(0)
    position = lattice(16, torch.float64)
    position = position + 0.9 * (torch.rand(position.shape, generator=generator, dtype=torch.float64) - 0.5)
    position[1::16] = position[0::16] + torch.tensor([0.1, 0.0])
    position = position.to(dtype)
    scene = Scene(spacing=1 / 16, fluid=Fluid(1.0, 0.01), period=(1.0, 1.0), reference_speed=1.0, dimension=2)
    run = resumed(scene, particles_at(position, taylor_green(position, 16)), backend)
    found = energies(run, 0.3)
    assert falling(found)
    assert found[-1] / found[0] == pytest.approx(math.exp(-16 * math.pi**2 * 0.01 * 0.3), rel=0.2)
    assert healthy(run) and 0.85 < float(run.record.smallest_density) < float(run.record.largest_density) < 1.1


def crowded(dtype, mass):
    """The vortex with a hundred particles of some mass in place of one."""
    generator = torch.Generator().manual_seed(1)
    crowd = 5.5 + torch.rand((100, 2), generator=generator, dtype=torch.float64)
    position = torch.cat([lattice(20, torch.float64), crowd]).to(dtype)
    start = particles_at(position, taylor_green(position))
    weight = torch.where(torch.arange(500) < 400, 1.0, mass).to(dtype)
    return start.changed(mass=weight).select(torch.arange(500) != 5 * 20 + 5)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_hundred_small_particles_in_the_place_of_one(dtype, backend):
    run = resumed(PERIODIC, crowded(dtype, 0.01), backend)
    assert falling(energies(run, 0.05))
    assert healthy(run) and 0.98 < float(run.record.smallest_density) < float(run.record.largest_density) < 1.03


def test_a_hundred_whole_particles_in_the_place_of_one_are_reported():
    """No weakly compressible fluid can be pressed a hundredfold: that member fails, and the other one decays."""
    both = crowded(torch.float64, 1.0)
    sane = particles_at(lattice(20, torch.float64), taylor_green(lattice(20, torch.float64)))
    start = Particles(
        **{n: getattr(both, n) for n in ("position", "velocity", "deviation", "mass", "member", "kind")}, members=2
    ).joined(sane.changed(member=sane.member + 1))
    run = resumed(PERIODIC, start, rollback=Rollback(tries=1, every=10))
    run.advance(0.05)
    assert run.record.failed.tolist() == [True, False] and run.record.rollbacks.tolist() == [1, 0]
    assert bool(torch.isfinite(run.particles.velocity).all())
    assert float(run.record.largest_density[1]) < 1.02 < float(run.record.largest_density[0])


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_ventricle_of_three_centimetres_in_float32_follows_float64(backend):
    """SI lengths of 0.03 m and blood entering at 0.6 m/s for 10 ms: the same field within 1e-4."""
    recording = geometry.Ventricle().recording(np.arange(0.28, 0.321, 0.01), grid_spacing=2.5e-3, wall_spacing=2e-3)
    scene = Scene.from_recording(recording, 2.5e-3)
    scheme = WeaklyCompressible()
    start = Simulator(scene, scheme, dtype=torch.float64).start(0.3, seed=1).particles
    mask = torch.from_numpy(np.array(recording.mask[2], bool))
    fields = []
    for dtype in PRECISIONS:
        cast = {n: getattr(start, n).to(dtype) for n in ("position", "velocity", "deviation", "mass")}
        run = Simulator(scene, scheme, dtype=dtype, backend=backend).resume(start.changed(**cast), 0.3)
        run.impose(recording.grid, torch.from_numpy(recording.velocity[2].astype(np.float64)), mask)
        run.advance(0.31)
        assert healthy(run)
        fields.append(run.fetch(recording.grid, mask).value.double())
    single, double = fields
    assert float((single - double).norm()) < 1e-4 * float(double.norm())
    assert 0.4 < float(double.abs().max()) < 1.2  # it jets in at about the mean speed that the volume asks for


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "backend"), [(torch.float32, "auto"), (torch.float64, "reference")])
def test_a_closed_box_does_not_drift_in_fifty_thousand_steps(dtype, backend):
    """Stirred once, then left alone: it comes to rest, keeps its density and centre, and no particle leaves."""
    size = 8 * 0.02
    corners = np.array([[0, 0], [size, 0], [size, size], [0, size]], float)
    walls = geometry.WallMotion.at_rest(geometry.polygon(corners, 0.005))
    scene = Scene(spacing=0.02, fluid=Fluid(1000.0, 1.0), walls=walls, reference_speed=1.0, dimension=2)
    run = Simulator(scene, WeaklyCompressible(sound_speed=10.0), dtype=dtype, backend=backend).start(0.0)
    stir = torch.randn(run.particles.position.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    run.particles = run.particles.changed(velocity=(0.1 * stir).to(dtype))
    begin, step = energy(run), 0.35 * 1.3 * 0.02 / 10
    run.advance(5_000 * step)
    early = run.particles
    run.advance(50_000 * step)
    late = run.particles
    assert int(run.record.steps) >= 50_000
    assert healthy(run) and int(run.record.outside) == 0
    assert energy(run) < 1e-9 * begin
    assert abs(float(late.deviation.mean() - early.deviation.mean())) < 1e-4
    assert float((late.position.mean(0) - early.position.mean(0)).abs().max()) < 0.02
    assert float(late.deviation.abs().max()) < 1e-3
