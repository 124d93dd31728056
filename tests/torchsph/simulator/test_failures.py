"""Members that fail: flagged and frozen, or rolled back and tried again, while the others go on as if alone."""

import math

import pytest
import torch

from torchsph import NumericalFailure, Rollback, Scene, Simulator, WeaklyCompressible
from torchsph.simulator.scene import Fluid
from torchsph.simulator.state.particles import Particles
from torchsph.simulator.state.record import LIMITS

SCENE = Scene(spacing=1 / 20, fluid=Fluid(1.0, 0.01), period=(1.0, 1.0), reference_speed=1.0, dimension=2)
BACKENDS = ["auto", "reference"]
PRECISIONS = [torch.float32, torch.float64]


def vortices(speeds, dtype=torch.float64, backend="auto", **changes):
    """Taylor-Green vortices on a lattice, one a member, as fast as ``speeds`` say."""
    axis = torch.arange(20, dtype=dtype) + 0.5
    position = torch.cartesian_prod(axis, axis)
    x, y = (2 * math.pi * position / 20).unbind(1)
    velocity = torch.stack([-torch.cos(x) * torch.sin(y), torch.sin(x) * torch.cos(y)], 1)
    one, label = torch.ones_like(x), torch.zeros(400, dtype=torch.int64)
    particles = Particles(position, velocity, 0 * one, one, label, label, 1).repeated(len(speeds))
    factor = torch.tensor(speeds, dtype=dtype)[particles.member]
    particles = particles.changed(velocity=particles.velocity * factor[:, None])
    scheme = WeaklyCompressible(**({"sound_speed": 10.0} | changes))
    return Simulator(SCENE, scheme, dtype=dtype, backend=backend).resume(particles, 0.0)


def energy(run):
    return run.particles.per_member(run.particles.velocity.square().sum(1), "sum")


def spoil(run, name, member, value=math.nan):
    """Make one value of one particle of a member not finite."""
    changed = getattr(run.particles, name).clone()
    changed[torch.nonzero(run.particles.member == member)[7]] = value
    run.particles = run.particles.changed(**{name: changed})


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("rollback", [None, Rollback(tries=2)])
@pytest.mark.parametrize("name", ["velocity", "position", "deviation"])
def test_the_others_go_on_bit_for_bit_as_if_alone(name, rollback, backend, dtype):
    """The failed member stands first, so that it would disturb every order of summation that counts from the start."""
    batch = vortices((1.0, 0.7, 0.4), dtype, backend, rollback=rollback)
    alone = vortices((0.7, 0.4), dtype, backend, rollback=rollback)
    spoil(batch, name, 0)
    for run in (batch, alone):
        run.advance(0.01)
        run.advance(0.02)
    mine = batch.particles.member > 0
    for field in ("position", "velocity", "deviation"):
        assert torch.equal(getattr(batch.particles, field)[mine], getattr(alone.particles, field))
    assert batch.record.failed.tolist() == [True, False, False]
    assert batch.record.steps[1:].tolist() == alone.record.steps.tolist()
    tries = 0 if rollback is None or name == "position" else 2  # a position that is lost cannot be tried again
    assert batch.record.rollbacks.tolist() == [tries, 0, 0]


def test_steps_far_too_long_are_taken_back_and_halved():
    """Six times the usual Courant fraction blows the vortex up; with a rollback it decays, and the record tells."""
    blown = vortices((1.0,), courant=2.0)
    before = energy(blown)
    with pytest.raises(NumericalFailure, match="beyond the densities that a liquid"):
        blown.advance(0.2)
    assert float(blown.record.largest_density) > 2
    saved = vortices((1.0, 1.0), courant=2.0, rollback=Rollback(tries=4, every=20, density=(0.8, 1.2)))
    saved.change(courant=[2.0, 0.35])
    saved.advance(0.2)
    assert not bool(saved.record.failed.any())
    assert int(saved.record.rollbacks[0]) >= 1 and int(saved.record.rollbacks[1]) == 0
    lost = energy(saved) / before
    assert 0.3 < float(lost[0]) < 0.5 and float(lost[1]) == pytest.approx(math.exp(-16 * math.pi**2 * 0.002), rel=0.45)
    plain = vortices((1.0,))
    plain.advance(0.2)
    mine = saved.particles.velocity[saved.particles.member == 1]
    torch.testing.assert_close(mine, plain.particles.velocity, rtol=1e-7, atol=1e-9)


def test_tries_are_bounded_and_the_last_good_state_stays():
    """A particle at two and a half times the rest density fails whatever the step: the member is frozen as it began."""
    run = vortices((1.0, 1.0), rollback=Rollback(tries=3))
    spoil(run, "deviation", 0, 1.5)
    start = run.particles
    run.advance(0.02)
    assert run.record.failed.tolist() == [True, False] and run.record.rollbacks.tolist() == [3, 0]
    mine = run.particles.member == 0
    assert torch.equal(run.particles.velocity[mine], start.velocity[:400])
    assert float(energy(run)[1]) < float((start.velocity[400:] ** 2).sum())


def test_rollback_options_that_cannot_be():
    with pytest.raises(ValueError, match="at least one try and one step, got 0, 50"):
        Rollback(tries=0)
    with pytest.raises(ValueError, match="must be a range around 1"):
        Rollback(density=(1.1, 2.0))


def test_when_the_last_member_fails_the_run_says_so():
    run = vortices((1.0, 0.5))
    spoil(run, "velocity", 0)
    run.advance(0.005)
    spoil(run, "position", 1, math.inf)
    with pytest.raises(NumericalFailure, match="all 2 members have failed .* after"):
        run.advance(0.01)


@pytest.mark.parametrize("order", ["thesis", "symplectic", "verlet", "predictor_corrector"])
def test_a_member_that_has_arrived_waits_without_moving(order):
    """Two members whose steps differ by the sound speed: each ends as it would alone, filter and smoothing included."""
    changes = {"order": order, "courant": 0.3}
    if order == "thesis":
        from torchsph import XSPH, PotentialWall

        changes |= {"xsph": XSPH(0.1), "wall": PotentialWall()}
    if order in ("thesis", "symplectic"):
        changes |= {"shepard_period": 3}
    both = vortices((1.0, 1.0), backend="reference", **changes)
    both.change(sound_speed=[10.0, 37.0])
    both.advance(0.005)
    both.advance(0.01)
    for member, sound in enumerate((10.0, 37.0)):
        alone = vortices((1.0,), backend="reference", **(changes | {"sound_speed": sound}))
        alone.advance(0.005)
        alone.advance(0.01)
        mine = both.particles.velocity[both.particles.member == member]
        torch.testing.assert_close(mine, alone.particles.velocity, rtol=1e-9, atol=1e-10)
        assert int(both.record.steps[member]) == int(alone.record.steps)


def test_the_record_names_everything_that_was_promised():
    """Finite flag, density range, Mach number, outside, overflows, steps, reasons, reductions, floor, rollbacks."""
    run = vortices((1.0, 0.5))
    if run._backend.name == "cpu":
        run._backend.entries_per_particle = 0.01  # the first list outgrows its room
    run.advance(0.02)
    summary = run.record.summary()
    for name in ("failed", "steps", "largest_mach", "outside", "reductions", "floored", "rollbacks"):
        assert len(summary[name]) == 2, name
    assert all(len(part) == 2 for part in summary["density_range"])
    assert set(summary["limited_by"]) == set(LIMITS)
    assert summary["largest_mach"] == pytest.approx([0.1, 0.05], rel=0.05)
    assert summary["overflows"] == (1 if run._backend.name == "cpu" else 0)
    assert summary["searches"] >= 1


@pytest.mark.parametrize("deviation", [-1.5, 4.0, 1e12])
def test_a_density_that_no_liquid_has_is_a_failure_without_a_rollback_too(deviation):
    """Runs that explode do so with finite numbers: a dam on a wedge went on at 3,000 m/s."""
    run = vortices((1.0, 0.7))
    spoil(run, "deviation", 0, deviation)
    run.advance(0.01)
    assert run.record.failed.tolist() == [True, False]
