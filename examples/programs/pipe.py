"""Steady flow through a round pipe with periodic ends, driven by a body force.

Prints the relative error of the velocities against Hagen and Poiseuille.
"""

import numpy as np
import torch

import geometry
from torchsph import Fluid, Scene, Simulator, WeaklyCompressible
from torchsph.validation.exact_wall_flows import CURVED_WALL_OPTIONS, pipe_flow

RADIUS, LENGTH, SPACING, VISCOSITY = 0.5, 1.0, 0.1, 0.1
FORCE = 4 * VISCOSITY / RADIUS**2  # 1 m/s on the axis


def main() -> float:
    tube = geometry.tube(RADIUS, LENGTH + 1.4, SPACING / 2)
    tube = tube.moved(tube.vertices - np.array([0, 0, 0.7]))  # the walls reach beyond both ends of the period
    walls = geometry.WallMotion.at_rest(tube)
    scene = Scene(SPACING, Fluid(1.0, VISCOSITY), walls, gravity=(0.0, 0.0, FORCE), period=(None, None, LENGTH))
    run = Simulator(scene, WeaklyCompressible(**CURVED_WALL_OPTIONS)).start(time=0.0)

    def exact() -> torch.Tensor:
        along = torch.zeros_like(run.particles.velocity)
        away = run.particles.position[:, :2].norm(dim=1) * run.units.length
        along[:, 2] = pipe_flow(away, VISCOSITY, FORCE, RADIUS) / run.units.speed
        return along

    run.particles = run.particles.changed(velocity=exact())
    run.advance(0.3)
    return float((run.particles.velocity - exact()).norm() / exact().norm())


if __name__ == "__main__":
    print(f"relative error {main():.4f}")
