"""Start-up of plane channel flows against their series, in a channel with walls and periodic ends."""

import numpy as np
import pytest

import geometry
from torchsph import Scene, Seeding, Simulator, preset, validation
from torchsph.scene import Fluid

VISCOSITY = 0.1


def channel_error(flow, across, times, **changes):
    """RMS velocity error over the largest velocity (1 m/s), at each of ``times`` (s)."""
    spacing = 1 / across
    length = 16 * spacing
    corners = np.array([[-8 * spacing, 0], [length + 8 * spacing, 0], [length + 8 * spacing, 1], [-8 * spacing, 1]])
    surface = geometry.polygon(corners, spacing)
    rates = np.zeros_like(surface.vertices)
    force = 8 * VISCOSITY if flow == "poiseuille" else 0.0
    if flow == "couette":
        rates[np.isclose(surface.vertices[:, 1], 1.0), 0] = 1.0
    walls = geometry.WallMotion(np.zeros(1), surface.vertices[None], rates[None], surface.faces, surface.region)
    scene = Scene(
        spacing=spacing, fluid=Fluid(1.0, VISCOSITY), walls=walls, period=(length, None), gravity=(force, 0.0),
        dimension=2,
    )  # fmt: skip
    scheme = preset("weakly_compressible", **(validation.CHANNEL_OPTIONS | changes))
    run = Simulator(scene, scheme, seeding=Seeding(jitter=0.0)).start(0.0)
    errors = []
    for time in times:
        run.advance(time)
        height = run.particles.position[:, 1].double() * spacing
        exact = (
            validation.poiseuille_start(height, time, VISCOSITY, force, 1.0)
            if flow == "poiseuille"
            else validation.couette_start(height, time, VISCOSITY, 1.0, 1.0)
        )
        errors.append(float((run.particles.velocity[:, 0].double() - exact).square().mean().sqrt()))
    assert int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())
    return errors


@pytest.mark.parametrize(("flow", "bound"), [("poiseuille", 0.002), ("couette", 0.004)])
def test_start_up_at_20_across(flow, bound):
    """RMS error over the largest velocity, through the start-up to the steady state: measured 0.13 and 0.33 %.

    The issue asks for 0.5 % at 40 across; 0.03 and 0.05 % are reached there at t = 0.5 s. Rows that are not centred
    between the walls cost up to 1 %.
    """
    assert max(channel_error(flow, 20, (0.1, 0.5, 2.0))) < bound


def test_no_slip_is_what_makes_the_profile():
    """With free slip a driven channel keeps accelerating as a plug: the error is of the size of the flow."""
    from torchsph import CompleteKernelWall

    assert channel_error("poiseuille", 20, (0.5,), wall=CompleteKernelWall(no_slip=False))[0] > 0.1


def test_walls_that_end_inside_the_period_are_refused():
    surface = geometry.polygon(np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), 0.05)
    scene = Scene(spacing=0.05, walls=geometry.WallMotion.at_rest(surface), period=(1.0, None), dimension=2)
    with pytest.raises(ValueError, match="axis 0 is periodic over 1 m, but the walls span only 0 to 1 m"):
        Simulator(scene)
