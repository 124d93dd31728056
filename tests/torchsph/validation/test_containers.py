"""Fluid at rest in a tilted box and in a sphere: hydrostatic pressure, and next to no motion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from wall_cases import assert_all_inside, assert_nothing_went_wrong

import geometry
from torchsph import Scene, Simulator, WeaklyCompressible
from torchsph.simulator.scene import Fluid

GRAVITY = 1.0


def container(name, spacing):
    if name == "sphere":
        return geometry.ellipsoid((0.5, 0.5, 0.5), 0.5 * spacing)
    box = geometry.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), spacing)
    return box.moved(Rotation.from_euler("xyz", [25, 35, 10], degrees=True).apply(box.vertices))


def settled(name, across, time, **changes):
    """(RMS pressure error over rho g H, largest speed over sqrt(g H)) after gravity was switched on at once."""
    surface = container(name, 1 / across)
    height = float(np.ptp(surface.vertices[:, 2]))
    scene = Scene(
        spacing=1 / across,
        fluid=Fluid(1.0, 0.05),
        walls=geometry.WallMotion.at_rest(surface),
        gravity=(0.0, 0.0, -GRAVITY),
    )
    scheme = WeaklyCompressible(**({"sound_speed": 10.0} | changes))
    run = Simulator(scene, scheme).start(0.0)
    run.advance(time)
    p = run.particles
    error = p.deviation.double() * scheme.sound_speed**2 + GRAVITY * p.position[:, 2].double() / across
    assert_nothing_went_wrong(run)
    assert_all_inside(run)
    scatter = float((error - error.mean()).square().mean().sqrt()) / (GRAVITY * height)
    return scatter, float(p.velocity.norm(dim=1).amax()) / np.sqrt(GRAVITY * height)


@pytest.mark.parametrize("name", ["sphere", "tilted box"])
def test_hydrostatic_pressure_at_12_across(name):
    """The issue asks for 1.5 % and 1 %; measured 0.9 and 0.5 % in the sphere, 0.7 and 0.7 % in the box."""
    pressure, speed = settled(name, 12, 1.2)
    assert pressure < 0.011
    assert speed < 0.009
