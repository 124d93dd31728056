"""Two dam breaks that were measured: a column in a plane tank, and SPHERIC's second test in space."""

from __future__ import annotations

import math

import numpy as np
import torch

import geometry
from torchsph.simulator.scene import Fluid, Scene
from torchsph.simulator.simulation import Simulation
from torchsph.simulator.simulator import Simulator

from .exact_flows import FREE_SURFACE_OPTIONS
from .free_surface import resting_block, wall_pressure
from .options import WeaklyCompressibleOptions

GRAVITY = 9.81  # m/s^2

# Column of width a and height 2 a: surge front x / a (second row) at t sqrt(2 g / a) (first row), dry bed
MARTIN_MOYCE_1952 = np.array(
    [
        [0.849, 1.212, 1.602, 2.283, 2.95, 3.598, 3.905, 4.592, 4.961, 5.316],
        [1.245, 1.443, 1.884, 2.689, 3.728, 4.528, 4.999, 5.841, 6.271, 6.717],
    ]
)
KOSHIZUKA_OKA_1996 = np.array(
    [
        [0.0, 0.381, 0.769, 1.153, 1.537, 1.935, 2.323, 2.719, 3.096],
        [1.0, 1.111, 1.252, 1.505, 1.892, 2.241, 2.615, 3.003, 3.624],
    ]
)

# SPHERIC test 2 (Kleefsman et al. 2005, sec. 6): tank, column, obstacle (lower and upper corner), probes P1, P3; m.
OBSTACLE_TANK = ((0.0, -0.5, 0.0), (3.22, 0.5, 1.0))
OBSTACLE_COLUMN = ((0.0, -0.5, 0.0), (1.228, 0.5, 0.55))
OBSTACLE = ((2.42, -0.2, 0.0), (2.58, 0.2, 0.161))
OBSTACLE_PROBES = ((2.42, 0.0, 0.021), (2.42, 0.0, 0.101))
# Waves that hit walls: without this damping single particles at the obstacle ring with 5 rho g H (chosen on P1 and P3)
IMPACT_OPTIONS: WeaklyCompressibleOptions = {
    **FREE_SURFACE_OPTIONS,
    "smoothing_ratio": 1.6,
    "bulk_damping": 1.0,
    "artificial_viscosity": 0.1,
}


def column_scene(spacing: float, width: float = 1.0, *, viscosity: float = 0.001) -> Scene:
    """A tank of 4 x 4 widths for a column of water of ``width`` (m), twice as high, in its left corner.

    Args:
        spacing: of the particles, m.
        width: of the column, m.
        viscosity: dynamic, Pa s.
    """
    corners = 4.0 * width * np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
    return Scene(
        spacing=spacing,
        fluid=Fluid(1000.0, viscosity),
        dimension=2,
        gravity=(0.0, -GRAVITY),
        walls=geometry.WallMotion.at_rest(geometry.polygon(corners, spacing)),
        reference_speed=math.sqrt(2 * GRAVITY * 2 * width),
    )


def obstacle_scene(spacing: float) -> Scene:
    """Tank and obstacle of SPHERIC's second test, filled with water; ``spacing`` of the particles, m."""
    tank = geometry.box(*OBSTACLE_TANK, 2 * spacing)
    # the obstacle reaches through the floor, so that its bottom is no wall that a particle sees
    depth = 2 * spacing
    lower, upper = np.array(OBSTACLE[0]) - (0.0, 0.0, depth), np.array(OBSTACLE[1])
    block = geometry.box(lower.tolist(), upper.tolist(), 2 * spacing)
    # its top comes first: a surface's check asks for the first vertex of a piece whether the piece lies in another
    inward = block.faces[np.argsort(-block.vertices[block.faces, 2].mean(1), kind="stable"), ::-1]
    walls = geometry.Surface(
        np.concatenate([tank.vertices, block.vertices]),
        np.concatenate([tank.faces, inward + len(tank.vertices)]),
    )
    return Scene(
        spacing=spacing,
        fluid=Fluid(1000.0, 0.001),
        gravity=(0.0, 0.0, -GRAVITY),
        walls=geometry.WallMotion.at_rest(walls),
        reference_speed=math.sqrt(2 * GRAVITY * OBSTACLE_COLUMN[1][2]),
    )


def obstacle_run(simulator: Simulator) -> Simulation:
    """The column of SPHERIC's second test at rest, its sides rounded to whole spacings of ``obstacle_scene``."""
    spacing = simulator.scene.spacing
    lower, upper = np.array(OBSTACLE_COLUMN)
    size = np.rint((upper - lower) / spacing) * spacing
    lower[1] = -0.5 * size[1]  # the measured plane stays the middle
    return simulator.resume(resting_block(simulator, lower, lower + size), 0.0)


def obstacle_pressures(run: Simulation, until: float, every: float = 0.005) -> tuple[np.ndarray, np.ndarray]:
    """Advance to ``until`` (s), reading the probes: times (n,), s, and p / (rho g H) (n, 2) at P1 and P3."""
    probes = torch.tensor(OBSTACLE_PROBES, dtype=torch.float64)
    unit = run.simulator.scene.fluid.density * GRAVITY * OBSTACLE_COLUMN[1][2]
    times, readings = np.arange(run.time + every, until + 0.5 * every, every), []
    for time in times:
        run.advance(float(time))
        readings.append(wall_pressure(run, probes)[0].numpy() / unit)
    return times, np.stack(readings)


def surge_front(run: Simulation) -> float:
    """Where the foremost particle of any member ends, m."""
    return (float(run.particles.position[:, 0].max()) + 0.5) * run.units.length


def front_error(time: np.ndarray, front: np.ndarray, measured: np.ndarray) -> float:
    """Mean of |computed / measured - 1| over the measured rows inside the times that were computed.

    Args:
        time: (n,), t sqrt(2 g / a).
        front: (n,), x / a.
        measured: (2, m), ``MARTIN_MOYCE_1952`` or ``KOSHIZUKA_OKA_1996``.

    Raises:
        ValueError: nothing was measured inside these times.
    """
    inside = (measured[0] >= time[0]) & (measured[0] <= time[-1])
    if not inside.any():
        raise ValueError(f"nothing was measured between {time[0]:g} and {time[-1]:g} t sqrt(2 g / a)")
    at, expected = measured[:, inside]
    return float(np.abs(np.interp(at, time, front) / expected - 1.0).mean())
