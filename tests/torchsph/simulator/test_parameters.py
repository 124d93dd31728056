"""Numbers that change: gamma's ramp, parameters per member and between steps; XSPH by centroids; sorted particles."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import j0

from torchsph import XSPH, GammaRamp, PotentialWall, Projection, Scene, Simulator, WeaklyCompressible, preset
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.simulator import spatial_sort
from torchsph.simulator.scene import Fluid
from torchsph.simulator.state.particles import Particles

PLAIN = {
    "pressure": "sum",
    "shifting": None,
    "artificial_viscosity": None,
    "bulk_damping": None,
    "density_diffusion": None,
    "laminar_viscosity": False,
}


def particles_at(position, velocity, deviation=None, members=1):
    one = torch.ones_like(position[:, 0])
    label = torch.zeros(len(position), dtype=torch.int64)
    particles = Particles(position, velocity, 0 * one if deviation is None else deviation, one, label, label, 1)
    return particles.repeated(members)


def lattice(*counts, dtype=torch.float64):
    return torch.cartesian_prod(*[torch.arange(n, dtype=dtype) + 0.5 for n in counts])


def wave_speed(sound_speed=10.0, members=1, changes=None, **options):
    """Phase speed (members,), m/s, of a standing sound wave over 32 spacings, from an eighth of its period.

    Divided by the Fourier transform of the kernel at the wave's number, by which SPH slows sound down (Dehnen & Aly
    2012 section 2.3).
    """
    count = 32
    scene = Scene(spacing=1 / count, fluid=Fluid(1.0, 0.0), period=(1.0, 10 / count), dimension=2)
    options = PLAIN | {"sound_speed": sound_speed, "smoothing_ratio": 1.5, "order": "predictor_corrector"} | options
    scheme = WeaklyCompressible(**options)
    position = lattice(count, 10)
    shape = torch.cos(2 * math.pi * position[:, 0] / count)
    start = particles_at(position, torch.zeros_like(position), 1e-4 * shape, members)
    run = Simulator(scene, scheme, dtype=torch.float64).resume(start, 0.0)
    run.change(**(changes or {}))
    time = 1 / sound_speed / 8
    run.advance(time)
    left = run.particles.per_member(run.particles.deviation * shape.repeat(members), "sum")
    share = left / (1e-4 * shape.square().sum())
    r = np.linspace(0.0, 3.0, 2001)
    smoothing = kernel("wendland_c2").value(torch.from_numpy(r), 1.5, 2).numpy()
    seen = np.trapezoid(2 * np.pi * r * smoothing * j0(2 * np.pi / count * r), r)
    return torch.acos(share) / (2 * math.pi * time) / seen


@pytest.mark.parametrize(("keep", "factor"), [("prefactor", 1 / math.sqrt(7)), ("sound_speed", 1.0)])
def test_a_fluid_at_the_start_of_its_ramp_carries_sound_at_the_speed_of_its_gamma(keep, factor):
    """c^2 = dp/drho of 2.25: with the prefactor kept it is gamma(t) / gamma of the full one (Batchelor 1967)."""
    ramp = GammaRamp(start=1.0, duration=1e9, keep=keep)
    assert float(wave_speed(gamma=7.0, gamma_ramp=ramp)) == pytest.approx(10.0 * factor, rel=2e-3)
    assert float(wave_speed(gamma=7.0)) == pytest.approx(10.0, rel=2e-3)


def test_gamma_grows_linearly_from_every_imposition_on():
    scene = Scene(spacing=1 / 12, fluid=Fluid(1.0, 0.0), period=(1.0, 1.0), dimension=2)
    scheme = WeaklyCompressible(gamma=5.0, gamma_ramp=GammaRamp(1.0, 0.1))
    run = Simulator(scene, scheme, dtype=torch.float64).start(2.0)
    gammas = []
    used = run._stepper.use
    run._stepper.use = lambda c: (gammas.append((float(c.gamma), float(c.sound_speed))), used(c))
    run.advance(2.2)
    assert gammas[0] == pytest.approx((1.0, 5.0 / math.sqrt(5.0)))
    assert gammas[-1] == (5.0, 5.0)  # the scheme's own, once, when the ramp is over
    steps = int(run.record.steps)
    assert len(gammas) < steps and [g for g, _ in gammas] == sorted(g for g, _ in gammas)
    grid_free = len(gammas)
    run.advance(2.3)
    assert len(gammas) == grid_free  # and costs nothing from then on
    stiff = Simulator(scene, replace(scheme, gamma_ramp=None), dtype=torch.float64).start(2.0)
    stiff.advance(2.2)
    assert steps < int(stiff.record.steps)  # a soft fluid takes longer steps


def test_a_ramp_that_starts_at_its_end_is_no_ramp():
    speeds = [wave_speed(gamma=3.0, gamma_ramp=ramp) for ramp in (None, GammaRamp(3.0, 1.0))]
    torch.testing.assert_close(*speeds, rtol=1e-12, atol=0)


def test_members_with_their_own_sound_speed():
    speeds = wave_speed(members=2, changes={"sound_speed": [10.0, 5.0]})
    assert speeds.tolist() == pytest.approx([10.0, 5.0], rel=2e-3)


def test_members_with_their_own_viscosity_decay_each_at_its_rate_and_another_one_from_now_on():
    """Kinetic energy of a Taylor-Green vortex falls as exp(-16 pi^2 nu t), nu changing half-way."""
    scene = Scene(spacing=1 / 24, fluid=Fluid(2.0, 0.0), period=(1.0, 1.0), dimension=2)
    scheme = WeaklyCompressible(sound_speed=10.0, artificial_viscosity=None, bulk_damping=None)
    position = lattice(24, 24)
    x, y = (2 * math.pi * position / 24).unbind(1)
    velocity = torch.stack([-torch.cos(x) * torch.sin(y), torch.sin(x) * torch.cos(y)], 1)
    run = Simulator(scene, scheme, dtype=torch.float64).resume(particles_at(position, velocity, members=2), 0.0)

    def energies():
        return run.particles.per_member(run.particles.velocity.square().sum(1), "sum")

    run.change(viscosity=[0.04, 0.1])  # Pa s at 2 kg/m^3
    before = energies()
    run.advance(0.05)
    middle = energies()
    run.change(viscosity=[0.1, 0.04])
    run.advance(0.1)
    rate = 16 * math.pi**2 * torch.tensor([0.02, 0.05]) * 0.05
    torch.testing.assert_close((middle / before).float(), torch.exp(-rate), rtol=0.03, atol=0)
    torch.testing.assert_close((energies() / middle).float(), torch.exp(-rate.flip(0)), rtol=0.03, atol=0)


@pytest.mark.parametrize("backend", ["auto", "reference"])
@pytest.mark.parametrize(
    "name",
    [
        "smoothing_ratio",
        "artificial_viscosity",
        "density_diffusion",
        "shifting",
        "bulk_damping",
        "courant",
        "gamma",
        "xsph",
        "background_pressure",
    ],
)
def test_a_changed_parameter_is_the_scheme_with_that_parameter(name, backend):
    """Each member of a batch moves as a run of its own whose scheme has its value from the start."""
    scene = Scene(spacing=1 / 16, fluid=Fluid(1.0, 0.01), period=(1.0, 1.0), dimension=2)
    scheme = WeaklyCompressible(xsph=XSPH(0.3, "position"), pressure="symmetric", artificial_viscosity=0.1)
    values = [0.2, 0.4] if name not in ("smoothing_ratio", "gamma") else [1.2, 1.6]
    generator = torch.Generator().manual_seed(0)
    position = lattice(16, 16) + 0.2 * torch.rand((256, 2), generator=generator, dtype=torch.float64)
    one = particles_at(position, torch.randn((256, 2), generator=generator, dtype=torch.float64))
    run = Simulator(scene, scheme, dtype=torch.float64, backend=backend).resume(one.repeated(2), 0.0)
    run.change(**{name: values})
    run.advance(0.01)
    for member, value in enumerate(values):
        own = replace(scheme, **({"xsph": XSPH(value, "position")} if name == "xsph" else {name: value}))
        alone = Simulator(scene, own, dtype=torch.float64, backend=backend).resume(one, 0.0)
        alone.advance(0.01)
        mine = run.particles.member == member
        torch.testing.assert_close(run.particles.velocity[mine], alone.particles.velocity, rtol=1e-9, atol=1e-9)
        assert int(run.record.steps[member]) == int(alone.record.steps)


def test_changes_that_cannot_be():
    scene = Scene(spacing=1 / 12, period=(1.0, 1.0), dimension=2)
    run = Simulator(scene, preset("weakly_compressible")).start(0.0, members=2)
    with pytest.raises(ValueError, match="unknown parameter 'speed'; known: sound_speed"):
        run.change(speed=1.0)
    with pytest.raises(ValueError, match=r"needs one value, or 2 for the members, got \(3,\)"):
        run.change(sound_speed=[1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="'sound_speed' must be positive"):
        run.change(sound_speed=[1.0, 0.0])
    with pytest.raises(ValueError, match="'gamma' cannot be switched off"):
        run.change(gamma=None)
    with pytest.raises(ValueError, match="'xsph' needs a scheme with XSPH"):
        run.change(xsph=0.1)
    with pytest.raises(TypeError, match="'viscosity' must be a number, or one for each member, got b'1'"):
        run.change(viscosity=b"1")
    with pytest.raises(ValueError, match="only shifting, courant, viscosity, valve_strength can change"):
        Simulator(scene, Projection()).start(0.0).change(sound_speed=1.0)
    with pytest.raises(ValueError, match="GammaRamp needs positive start and duration"):
        GammaRamp(0.0)
    with pytest.raises(ValueError, match="XSPH form must be"):
        XSPH(form="cells")


def centroid_pull(position, velocity, volume, side, cells, h):
    """Sum over adjacent cells of V_c (v_c - v_a) W(|x_a - X_c|), cell by cell in plain numpy (thesis 5.2)."""
    edge = side / cells
    index = np.floor(position / edge).astype(int)
    pull = np.zeros_like(velocity)
    smoothing = kernel("wendland_c2")
    for a in range(len(position)):
        for offset in itertools.product((-1, 0, 1), repeat=2):
            target = index[a] + offset
            inside = (index == target % cells).all(1)
            if inside.any():
                mean = velocity[inside].mean(0)  # by mass, which is one
                gap = np.linalg.norm(position[a] - (target + 0.5) * edge)
                weight = float(smoothing.value(torch.tensor(gap), h, 2))
                pull[a] += volume[inside].sum() * (mean - velocity[a]) * weight
    return pull


@pytest.mark.parametrize("level", ["velocity", "position"])
def test_centroid_xsph_of_a_step_is_its_formula(level):
    """The step with it differs from the step without by epsilon times the sum over cells, or its displacement."""
    scene = Scene(spacing=1 / 14, fluid=Fluid(1.0, 0.0), period=(1.0, 1.0), dimension=2)
    order = "thesis" if level == "velocity" else "symplectic"
    generator = torch.Generator().manual_seed(3)
    position = lattice(14, 14) + 0.3 * torch.rand((196, 2), generator=generator, dtype=torch.float64)
    start = particles_at(position, torch.randn((196, 2), generator=generator, dtype=torch.float64))
    ends, time = [], 1e-4
    for xsph in (None, XSPH(0.3, level, "centroid")):
        scheme = WeaklyCompressible(order=order, wall=PotentialWall(), xsph=xsph, **PLAIN)
        run = Simulator(scene, scheme, dtype=torch.float64).resume(start, 0.0)
        run.advance(time)
        assert int(run.record.steps) == 1
        ends.append(run.particles)
    without, with_it = ends
    # 1.5 cells hold the support of 2.6 spacings: 14 / (2.6 / 1.5) = 8 whole cells
    p = without if level == "velocity" else start
    pull = centroid_pull(
        torch.remainder(p.position, 14).numpy(), p.velocity.numpy(), 1 / (1 + p.deviation).numpy(), 14.0, 8, 1.3
    )
    if level == "velocity":
        np.testing.assert_allclose((with_it.velocity - without.velocity).numpy(), 0.3 * pull, atol=1e-12)
    else:
        moved = torch.remainder(with_it.position - without.position + 7, 14) - 7
        np.testing.assert_allclose(moved.numpy(), 0.3 * time * 14 * pull, atol=1e-12)


def test_centroid_xsph_does_not_depend_on_the_other_members():
    """Cells stand where they stand in space, whatever else is in the batch."""
    scene = Scene(spacing=1 / 14, fluid=Fluid(1.0, 0.0), dimension=2)
    scheme = WeaklyCompressible(xsph=XSPH(0.3, "position", "centroid"))
    generator = torch.Generator().manual_seed(3)
    one = particles_at(lattice(9, 9), torch.randn((81, 2), generator=generator, dtype=torch.float64))
    far = replace(one.changed(position=one.position - 3.7), member=one.member + 1, members=2)
    ends = []
    for start in (one, replace(one, members=2).joined(far)):
        run = Simulator(scene, scheme, dtype=torch.float64).resume(start, 0.0)
        run.advance(1e-3)
        ends.append(run.particles.velocity[:81])
    assert torch.equal(*ends)


def test_sorting_in_space_leaves_the_caller_its_particles(monkeypatch):
    """Shuffled particles come back in the order in which they were given, moved as they would be without sorting."""
    scene = Scene(spacing=1 / 16, fluid=Fluid(1.0, 0.01), period=(1.0, 1.0), dimension=2)
    generator = torch.Generator().manual_seed(5)
    shuffled = torch.randperm(256, generator=generator)
    place = lattice(16, 16)[shuffled]
    start = particles_at(place, torch.randn((256, 2), generator=generator, dtype=torch.float64), members=2)
    ends = []
    for least in (10**9, 0):
        monkeypatch.setattr(spatial_sort, "_SORT_FROM", least)
        monkeypatch.setattr(spatial_sort, "_SORT_EVERY", 2)
        run = Simulator(scene, preset("weakly_compressible"), dtype=torch.float64).resume(start, 0.0)
        for k in range(1, 4):
            run.advance(0.01 * k)
        moved = run._spatial.order is not None and not torch.equal(run._spatial.order, torch.arange(512))
        assert moved == (least == 0 and run._backend.name == "cpu")
        ends.append(run.particles)
    torch.testing.assert_close(ends[0].position, ends[1].position, rtol=0, atol=1e-9)
    assert torch.equal(ends[0].member, ends[1].member) and ends[1].label is None
