"""Scenes between walls whose flow is known: pipes with periodic ends, cylinders, containers."""

from __future__ import annotations

import numpy as np
import torch

import geometry
from torchsph import Scene, Simulator, WeaklyCompressible
from torchsph.simulator.scene import Fluid
from torchsph.validation import exact_wall_flows as validation_walls

RADIUS = 0.5


def pipe(across, viscosity, gravity, length=10, dtype=torch.float32, **changes):
    """A run in a pipe of diameter 1 m along z, ``across`` particles wide, ``length`` spacings long and periodic."""
    spacing = 1 / across
    tube = geometry.tube(RADIUS, (length + 14) * spacing, 0.5 * spacing)
    tube = tube.moved(tube.vertices - np.array([0, 0, 7 * spacing]))
    scene = Scene(
        spacing=spacing,
        fluid=Fluid(1.0, viscosity),
        walls=geometry.WallMotion.at_rest(tube),
        period=(None, None, length * spacing),
        gravity=gravity,
    )
    scheme = WeaklyCompressible(**(validation_walls.CURVED_WALL_OPTIONS | changes))
    return Simulator(scene, scheme, dtype=dtype).start(0.0)


def axis_distance(run):
    """Distance (n,), m, of the particles from the z axis, float64."""
    return run.particles.position[:, :2].double().norm(dim=1) * run.units.length


def fill_with(run, along):
    """Give the particles the velocity ``along`` (n,) along z."""
    velocity = torch.zeros_like(run.particles.velocity)
    velocity[:, 2] = along.to(velocity.dtype)
    run.particles = run.particles.changed(velocity=velocity)


def annulus(inner, outer, spacing):
    """The plane region between two circles, as a closed surface of two polylines."""

    def ring(radius, turn):
        count = round(2 * np.pi * radius / spacing)
        angle = turn * 2 * np.pi * np.arange(count) / count
        number = np.arange(count)
        return radius * np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([number, np.roll(number, -1)], 1)

    (outside, faces), (inside, more) = ring(outer, 1), ring(inner, -1)
    surface = geometry.Surface(np.concatenate([outside, inside]), np.concatenate([faces, more + len(outside)]))
    surface.check()
    return surface


def assert_nothing_went_wrong(run):
    """No particle beyond the walls, by their own account; no failure."""
    assert int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())


def assert_all_inside(run):
    """Every particle inside the walls as they are now, by the surface's winding number: slow for large surfaces."""
    surface = run.simulator.scene.walls.surface(run.time)
    points = run.particles.position[run.particles.fluid].double().numpy() * run.units.length
    assert (geometry.winding_number(surface.vertices, surface.faces, points) > 0.5).all()
