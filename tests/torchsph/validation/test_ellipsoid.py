"""A pulsating ellipsoid with one open end against an independent potential flow: flux, core, leaks, ten beats."""

import numpy as np
import pytest

from torchsph.validation.ellipsoid import PotentialFlow, PulsatingEllipsoid

BODY = PulsatingEllipsoid()


def places(count=3000):
    """Points in the core at t = 0, m."""
    unit = np.random.default_rng(0).uniform(-1, 1, (count, 3))
    unit = unit[(np.linalg.norm(unit, axis=1) < 0.75) & (unit[:, 2] < BODY.plane - 0.2)]
    return unit * (BODY.radius, BODY.radius, BODY.height)


def test_the_potential_flow_is_exact_for_a_strain_and_has_converged():
    """A strain that keeps the volume is its own potential flow; else twice as fine harmonics change it by 1e-3."""
    strain = np.array([5.0, 5.0, -10.0])
    kept = PotentialFlow(BODY.radius, BODY.height, BODY.plane, strain, 0.0, 20)
    np.testing.assert_allclose(kept.velocity(places()), strain * places(), atol=1e-12)
    coarse, fine = (BODY.flow(0.05, order).velocity(places()) for order in (30, 60))
    assert np.linalg.norm(coarse - fine) < 1e-3 * np.linalg.norm(fine)


def test_the_volume_is_that_of_the_closed_form():
    motion = BODY.motion(0.5e-3)
    for time in (0.0, 0.03, 0.07):
        assert motion.volume(time) == pytest.approx(BODY.volume(time), rel=2e-3)
        assert motion.volume_rate(time) == pytest.approx(BODY.volume_rate(time), rel=2e-3, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "bound"), [("projection", 0.065), pytest.param("weakly_compressible", 0.11, marks=pytest.mark.slow)]
)
def test_ejection_follows_the_potential_flow(name, bound):
    """From rest through peak flow, 16 across, every particle of the core."""
    run, wrong, flow = BODY.start(name), 0.0, 0.0
    first = BODY.missing(run)
    for part in (0.1, 0.2, 0.3):
        run.advance(part * BODY.period)
        error, exact = BODY.core_errors(run)
        wrong, flow = wrong + error, flow + exact
    assert (wrong / flow) ** 0.5 < bound
    passed = BODY.volume(0.0) * (1 - first) - BODY.volume(run.time) * (1 - BODY.missing(run))
    assert passed == pytest.approx(BODY.volume(0.0) - BODY.volume(run.time), rel=0.03)
    assert int(run.record.outside.sum()) == 0 and int(run.record.crossed_wall.sum()) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["projection", "weakly_compressible"])
def test_ten_beats_neither_leak_nor_drift(name):
    """The flux is dV/dt within 1 % of the stroke at every half beat, and the volume comes back within 0.5 %."""
    run, wrong = BODY.start(name), []
    for half in range(1, 21):
        run.advance(0.5 * half * BODY.period)
        wrong.append(BODY.missing(run))
        print(name, half / 2, wrong[-1], run.record.summary()["filling"], run.record.summary()["density_range"])
        assert int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())
    assert max(map(abs, wrong)) < 0.01 * BODY.stroke
    assert max(wrong[1::2]) - min(wrong[1::2]) < 0.005
