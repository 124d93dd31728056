"""Couette flow between cylinders, the inner one turning, in the plane."""

import numpy as np
import pytest
import torch
from wall_cases import annulus, assert_all_inside, assert_nothing_went_wrong

import geometry
from torchsph import Scene, Simulator, WeaklyCompressible
from torchsph.simulator.scene import Fluid
from torchsph.validation import exact_wall_flows as validation_walls

INNER, OUTER, VISCOSITY = 0.5, 1.0, 0.1


def couette_error(across, time, **changes):
    """Relative L2 error of the velocity at ``time`` (s), from the steady state at the start."""
    spacing = (OUTER - INNER) / across
    surface = annulus(INNER, OUTER, 0.5 * spacing)
    rates = np.zeros_like(surface.vertices)
    turning = np.linalg.norm(surface.vertices, axis=1) < 0.5 * (INNER + OUTER)
    rates[turning] = np.stack([-surface.vertices[turning, 1], surface.vertices[turning, 0]], 1) / INNER
    walls = geometry.WallMotion(np.zeros(1), surface.vertices[None], rates[None], surface.faces, surface.region)
    scene = Scene(spacing=spacing, fluid=Fluid(1.0, VISCOSITY), walls=walls, dimension=2)
    options = validation_walls.CURVED_WALL_OPTIONS | {"smoothing_ratio": 2.0} | changes
    run = Simulator(scene, WeaklyCompressible(**options)).start(0.0)

    def exact():
        place = run.particles.position.double() * spacing
        radius = place.norm(dim=1)
        speed = validation_walls.cylinder_couette(radius, (INNER, 1.0), (OUTER, 0.0)) / radius
        return speed[:, None] * torch.stack([-place[:, 1], place[:, 0]], 1)

    run.particles = run.particles.changed(velocity=exact().float())
    run.advance(time)
    assert_nothing_went_wrong(run)
    assert_all_inside(run)
    return float((run.particles.velocity.double() - exact()).norm() / exact().norm())


def test_couette_between_cylinders_at_8_across():
    """The issue asks for 2 %; 0.7 % was measured, after four times the gap's diffusion time."""
    assert couette_error(8, 1.0) < 0.01


@pytest.mark.slow
def test_couette_between_cylinders_at_16_across():
    """0.2 % with even particles, 2.5 to 3 % with the default's weak shifting: disorder is what is left."""
    assert couette_error(16, 2.0) < 0.004
    assert couette_error(16, 2.0, shifting=0.5, shifting_speed="local") > 0.02


def test_the_analytic_flow_sticks_to_both_cylinders():
    ends = torch.tensor([INNER, OUTER], dtype=torch.float64)
    speed = validation_walls.cylinder_couette(ends, (INNER, 0.7), (OUTER, -0.3))
    torch.testing.assert_close(speed, torch.tensor([0.7, -0.3], dtype=torch.float64))
