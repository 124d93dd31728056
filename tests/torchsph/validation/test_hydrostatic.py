"""A resting column of fluid in a closed box: pressure grows linearly downwards and nothing moves."""

import numpy as np
import pytest
import torch

import geometry
from torchsph import Scene, Simulator, WeaklyCompressible
from torchsph.simulator.scene import Fluid

GRAVITY = 1.0


def column(**changes):
    """(pressure gradient over -rho g by regression, RMS deviation over the bottom-to-top difference, RMS speed)."""
    size, spacing = 1.0, 0.05
    surface = geometry.polygon(size * np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), spacing)
    scene = Scene(
        spacing=spacing,
        fluid=Fluid(1.0, 0.05),
        walls=geometry.WallMotion.at_rest(surface),
        gravity=(0.0, -GRAVITY),
        dimension=2,
    )
    scheme = WeaklyCompressible(**({"sound_speed": 10.0, "smoothing_ratio": 2.0} | changes))
    run = Simulator(scene, scheme, dtype=torch.float64).start(0.0)
    run.advance(3.0)
    p = run.particles
    height = p.position[:, 1].numpy() * spacing
    pressure = p.deviation.numpy() * scheme.sound_speed**2
    slope, offset = np.polyfit(height, pressure, 1)
    scatter = np.sqrt(np.mean((pressure - slope * height - offset) ** 2)) / (GRAVITY * size)
    assert int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())
    return -slope / GRAVITY, scatter, float(p.velocity.square().sum(1).mean().sqrt())


def test_hydrostatic_pressure():
    """Measured at 20 across: gradient 0.4 % high, pressure within 0.5 % RMS of a line (1 % asked for), 1.3 mm/s left.

    The free-fall speed of the box is 1.4 m/s; what scatters is the row of particles next to the walls.
    """
    slope, scatter, speed = column()
    assert slope == pytest.approx(1.0, abs=0.006)
    assert scatter < 0.008
    assert speed < 0.003
