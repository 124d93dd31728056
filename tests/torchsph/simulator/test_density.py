"""What acts on the density: forms of its diffusion, of its filter, and an equation of state that cannot pull."""

import pytest
import torch

from torchsph import PotentialWall, Scene, Simulator, WeaklyCompressible
from torchsph.simulator.scene import Fluid
from torchsph.simulator.state.particles import Particles

BACKENDS = ["auto", "reference"]
OPEN = Scene(spacing=0.02, fluid=Fluid(1000.0, 0.0), reference_speed=1.0, dimension=2)
STILL = {"shifting": None, "artificial_viscosity": None, "bulk_damping": None}


def block(side=12):
    """A disordered block with free surfaces at rest, its density linear in x and y, its masses those of the density."""
    generator = torch.Generator().manual_seed(0)
    axis = torch.arange(side, dtype=torch.float64)
    position = torch.cartesian_prod(axis, axis)
    position = position + 0.3 * torch.rand(position.shape, generator=generator, dtype=torch.float64)
    deviation = 1e-3 * (position[:, 0] - 2 * position[:, 1])
    label = torch.zeros(side * side, dtype=torch.int64)
    return Particles(position, torch.zeros_like(position), deviation, 1 + deviation, label, label, 1)


def after_one_step(backend, time=1e-5, **changes):
    options = {"sound_speed": 10.0, "density_diffusion": None} | STILL | changes
    scheme = WeaklyCompressible(**options)
    run = Simulator(OPEN, scheme, dtype=torch.float64, backend=backend).resume(block(), 0.0)
    run.advance(time)
    assert int(run.record.steps) == 1
    return float((run.particles.deviation - block().deviation).abs().max())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("order", ["symplectic", "thesis", "verlet", "predictor_corrector"])
def test_corrected_diffusion_leaves_a_linear_density_alone(order, backend):
    """Antuono et al. 2010 eq. 4, up to free surfaces; the plain form smears it out there."""
    changes = {"order": order, "density_diffusion": 0.1, "time": 1e-4, "continuity": "volume", "pressure": "sum"}
    if order == "thesis":
        changes["wall"] = PotentialWall()
    base = after_one_step(backend, **(changes | {"density_diffusion": None}))
    plain = after_one_step(backend, **changes)
    corrected = after_one_step(backend, diffusion_form="corrected", **changes)
    if order in ("symplectic", "thesis"):
        assert base == 0.0 and corrected < 1e-15  # at rest nothing else changes the density in the first step
    else:
        assert corrected == pytest.approx(base, rel=0.01)
    assert plain > 1.5 * max(corrected, base)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("order", ["symplectic", "thesis"])
def test_the_mls_filter_leaves_a_linear_density_alone(order, backend):
    """Masses are linear in space: moving least squares return them, Shepard's filter only far from the surface."""
    changes = {"order": order, "shepard_period": 1, "wall": PotentialWall()}
    assert after_one_step(backend, density_filter="mls", **changes) < 1e-6
    assert after_one_step(backend, **changes) > 5e-4


def test_hughes_graham_halves_fly_apart_without_being_held_back():
    """No negative pressure: what is pulled apart keeps its momentum; the plain equation holds it back at first."""
    speeds = []
    for hughes_graham in (False, True):
        axis = torch.arange(12, dtype=torch.float64) + 0.5
        position = torch.cartesian_prod(axis, axis)
        right = position[:, 0] > 6
        velocity = torch.zeros_like(position)
        velocity[right, 0] = 1.0
        label = torch.zeros(144, dtype=torch.int64)
        one = torch.ones(144, dtype=torch.float64)
        start = Particles(position, velocity, 0 * one, one, label, label, 1)
        options = STILL | {"sound_speed": 10.0, "pressure": "symmetric", "density_diffusion": None}
        scheme = WeaklyCompressible(hughes_graham=hughes_graham, **options)
        run = Simulator(OPEN, scheme, dtype=torch.float64).resume(start, 0.0)
        run.advance(0.01)
        speeds.append(float(run.particles.velocity[right, 0].mean()))
    held, free = speeds
    assert held < 0.95 < 0.999 < free <= 1.0 + 1e-12


def test_hughes_graham_pressure_is_that_of_the_thesis():
    """2.25 at rho* = max(rho, rho0)."""
    scheme = WeaklyCompressible(gamma=7.0, sound_speed=10.0, hughes_graham=True)
    simulator = Simulator(OPEN, scheme, dtype=torch.float64)
    start = block()
    pressure = simulator.resume(start, 0.0)._stepper.pressure(start)
    density = (1 + start.deviation).clamp_min(1.0)
    torch.testing.assert_close(pressure, 100 / 7 * (density**7 - 1), rtol=1e-9, atol=1e-12)


def test_forms_that_do_not_exist():
    with pytest.raises(ValueError, match="diffusion_form must be one of"):
        WeaklyCompressible(diffusion_form="antuono")
    with pytest.raises(ValueError, match="density_filter must be one of"):
        WeaklyCompressible(density_filter="least squares")
