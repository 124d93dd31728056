"""How much of a start's motion is the start's own: a fluid that should rest, and what moves in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from geometry import WallMotion
from geometry.arguments import between, checked

from .simulator import Simulator


@dataclass(frozen=True)
class ResidualMotion:
    """How a fluid moves that should rest: RMS and largest speed of its particles, m/s."""

    rms: float
    largest: float


@checked(duration=between(1e-9, 1.0))
def residual_motion(simulator: Simulator, time: float, *, duration: float = 0.02, seed: int = 0) -> ResidualMotion:
    """What a start at ``time`` (s) leaves moving after ``duration`` (s), with walls held still and no forces or valves.

    None of it is flow: it is the noise floor of what is imposed on such a start.
    """
    walls = simulator.scene.walls
    still = None if walls is None else WallMotion.at_rest(walls.surface(time))
    scene = replace(simulator.scene, walls=still, valves=(), gravity=None)
    run = replace(simulator, scene=scene).start(0.0, seed=seed)
    run.advance(duration)
    speed = run.particles.velocity.double().norm(dim=1) * run.units.speed
    return ResidualMotion(float(speed.square().mean().sqrt()), float(speed.max()))
