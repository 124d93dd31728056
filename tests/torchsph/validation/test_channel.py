"""Start-up of plane channel flows against their series, in a channel with walls and periodic ends."""

import numpy as np
import pytest

import geometry
from torchsph import CompleteKernelWall, Scene, Simulator, WeaklyCompressible
from torchsph.validation import exact_flows as validation
from torchsph.validation.runs import channel, channel_error


def worst_error(flow, across, times, **changes):
    """Largest RMS velocity error over the largest velocity (1 m/s) at any of ``times`` (s)."""
    run = channel(flow, across, scheme=WeaklyCompressible(**(validation.CHANNEL_OPTIONS | changes)))
    errors = []
    for time in times:
        run.advance(time)
        errors.append(channel_error(run))
    assert int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())
    return max(errors)


@pytest.mark.parametrize(("flow", "bound"), [("poiseuille", 0.002), ("couette", 0.004)])
def test_start_up_at_20_across(flow, bound):
    """RMS error over the largest velocity, through the start-up to the steady state: measured 0.10 and 0.30 %.

    Rows that are not centred between the walls would cost up to 1 %.
    """
    assert worst_error(flow, 20, (0.1, 0.5, 2.0)) < bound


@pytest.mark.slow
@pytest.mark.parametrize("flow", ["poiseuille", "couette"])
def test_start_up_at_40_across(flow):
    """A quarter of the 0.5 % that the issue asks for, until t = 0.5 s: measured 0.03 and 0.10 %."""
    assert worst_error(flow, 40, (0.1, 0.25, 0.5)) < 0.00125


def test_no_slip_is_what_makes_the_profile():
    """With free slip a driven channel keeps accelerating as a plug: the error is of the size of the flow."""
    assert worst_error("poiseuille", 20, (0.5,), wall=CompleteKernelWall(no_slip=False)) > 0.1


def test_walls_that_end_inside_the_period_are_refused():
    surface = geometry.polygon(np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), 0.05)
    scene = Scene(spacing=0.05, walls=geometry.WallMotion.at_rest(surface), period=(1.0, None), dimension=2)
    with pytest.raises(ValueError, match="axis 0 is periodic over 1 m, but the walls span only 0 to 1 m"):
        Simulator(scene)
