"""A wall model of your own: options, what it does to particles, one line that registers it.

A sticky wall: what touches it comes to rest across it. Prints the part of its energy that a block of fluid, thrown at
it, has lost.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch

import geometry
from torchsph import Fluid, Scene, Simulator, WeaklyCompressible
from torchsph.simulator.walls.potential import PotentialForces
from torchsph.simulator.walls.registry import wall_forces
from torchsph.validation.exact_flows import FREE_SURFACE_OPTIONS
from torchsph.validation.free_surface import resting_block


@dataclass(frozen=True)
class StickyWall:
    """Options of the wall: how far it reaches, in particle spacings, and how hard it pushes."""

    reach: float = 1.0
    stiffness: float = 0.4
    relaxation: ClassVar[None] = None
    complete, hard, gap, sliding, no_slip = False, False, 0.0, False, False
    needs_compressible: ClassVar[bool] = True


class StickyForces(PotentialForces):
    """The force of a potential wall; what comes in at the wall is stopped instead of thrown back."""

    def damp(self, fluid, wall, dt):
        inward = ((fluid.velocity - wall.velocity) * wall.normal).sum(1).clamp(max=0.0)
        close = wall.distance < 0.5 * self.model.reach
        return fluid.velocity - torch.where(close, inward, 0.0)[:, None] * wall.normal


@wall_forces.register
def _(model: StickyWall) -> StickyForces:
    return StickyForces(model)


def main() -> float:
    walls = geometry.WallMotion.at_rest(geometry.box((0, 0, 0), (1, 1, 1), 0.2))
    scene = Scene(0.1, Fluid(1000.0, 0.001), walls)
    options = FREE_SURFACE_OPTIONS | {"wall": StickyWall(), "sound_speed": 20.0}
    simulator = Simulator(scene, WeaklyCompressible(**options))
    run = simulator.resume(resting_block(simulator, (0.3, 0.3, 0.1), (0.7, 0.7, 0.5)), time=0.0)
    run.particles = run.particles.changed(velocity=run.particles.velocity + torch.tensor([0.0, 0.0, -1.0]))
    run.advance(0.3)
    return 1.0 - float(run.particles.velocity.square().sum(1).mean())


if __name__ == "__main__":
    print(f"lost {main():.3f} of its energy")
