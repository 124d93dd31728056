"""A block of fluid falls on a wedge that splits it, with both kinds of walls (Grønli 2017, fig. 4.6)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from itertools import zip_longest

import numpy as np
import torch
from matplotlib.figure import Figure

import geometry
import torchsph as ts
from torchsph.simulator.simulation import Simulation
from torchsph.validation.exact_flows import FREE_SURFACE_OPTIONS
from torchsph.validation.free_surface import resting_block

from ..material import Material
from ..record import Claim, Result
from ..style import axes

GRAVITY = 9.81  # m/s^2
TANK = np.array([[0, 0], [0.8, 0], [1.0, 0.6], [1.2, 0], [2, 0], [2, 2], [0, 2]], np.float64)  # m
BLOCK = ((0.7, 0.64), (1.3, 1.24))  # m, lower and upper corner
TIMES = (0.05, 0.2, 0.4, 0.6)  # s


def scene(spacing: float) -> ts.Scene:
    """A tank with a wedge on its floor."""
    return ts.Scene(
        spacing=spacing,
        fluid=ts.Fluid(1000.0, 0.001),
        dimension=2,
        gravity=(0.0, -GRAVITY),
        walls=geometry.WallMotion.at_rest(geometry.polygon(TANK, spacing)),
        reference_speed=math.sqrt(2 * GRAVITY * 1.4),
    )


def schemes(speed: float, stiffness: float) -> dict[str, ts.WeaklyCompressible]:
    """The thesis's physics with its potential walls, and complete kernels; sound ``stiffness`` times the speed."""
    thesis = ts.preset("thesis", sound_speed=stiffness * speed, steps_per_frame=None, background_pressure=0.0)
    own = ts.WeaklyCompressible(**(FREE_SURFACE_OPTIONS | {"sound_speed": stiffness * speed}))
    return {"thesis": thesis, "default": own}


def make(material: Material) -> Result:
    """Where the fluid is over time: its gap from the wedge, its halves left and right, what left the tank."""
    spacing = 0.04 if material.fast else 0.02
    tank, times = scene(spacing), TIMES[1:2] if material.fast else TIMES
    numbers, shown = {}, {}
    for name, scheme in schemes(tank.reference_speed, 5.0 if material.fast else 10.0).items():
        model = ts.Simulator(tank, scheme)
        run = model.resume(resting_block(model, *BLOCK), 0.0)
        shown[name] = _until_it_breaks(run, times)
        last = np.concatenate([points for points, _ in shown[name][-3:]])
        start = float(BLOCK[1][1] - BLOCK[0][1])
        numbers[name] = {
            "gap_in_spacings": _gap(last, spacing),
            "left_of_the_tip": float((shown[name][-1][0][:, 0] < 1.0).mean()),
            "outside": int(run.record.outside.sum()),
            "particles": run.particles.count,
            "steps": int(run.record.steps),
            "front_fell": start + BLOCK[0][1] - float(shown[name][-1][0][:, 1].max()),
            "lasted_s": times[len(shown[name]) - 1],
            "energy_over_start": _energy(*shown[name][-1]) / (GRAVITY * (BLOCK[0][1] + BLOCK[1][1]) / 2),
        }
    split = [abs(found["left_of_the_tip"] - 0.5) for found in numbers.values()]
    claims = [
        Claim(
            "the wedge splits the falling block and the flow looks natural",
            max(split) < 0.05
            and all(found["outside"] == 0 and found["energy_over_start"] < 1.02 for found in numbers.values())
            and all(len(states) == len(times) for states in shown.values()),
            f"left of the tip {numbers['thesis']['left_of_the_tip']:.3f} and "
            f"{numbers['default']['left_of_the_tip']:.3f} of the particles; "
            f"{numbers['thesis']['outside']} and {numbers['default']['outside']} outside; energy at the end over that "
            f"of the start {numbers['thesis']['energy_over_start']:.2f} and "
            f"{numbers['default']['energy_over_start']:.2f}; good for {numbers['thesis']['lasted_s']:g} and "
            f"{numbers['default']['lasted_s']:g} s of {times[-1]:g}",
        ),
        Claim(
            "a gap stays between the wedge and the fluid",
            numbers["thesis"]["gap_in_spacings"] > 0.75,
            f"nearest particles {numbers['thesis']['gap_in_spacings']:.2f} spacings from the wedge with potential "
            f"walls, {numbers['default']['gap_in_spacings']:.2f} with complete kernels (half a spacing is none)",
        ),
    ]

    def draw() -> Figure:
        figure, panels = axes(2, len(times), 2.4 * len(times), 2.4)
        for line, (name, states) in zip(panels, shown.items(), strict=True):
            for axis, state, time in zip_longest(line, states, times):
                if state is not None:
                    axis.scatter(*state[0].T, c=state[1], s=1.5, cmap="viridis", vmin=0, vmax=4)
                else:
                    axis.text(1.0, 1.0, "failed", ha="center")
                axis.fill(*TANK[1:4].T, color="0.7")
                axis.plot(*np.vstack([TANK, TANK[:1]]).T, color="0.4", linewidth=0.8)
                axis.set(xlim=(0, 2), ylim=(0, 1.5), aspect="equal", xticks=[], yticks=[], title=f"{time:.1f} s")
            line[0].set_ylabel(name)
        return figure

    return Result(numbers, claims, material.settings(recording=None, spacing_m=spacing), draw)


def _until_it_breaks(run: Simulation, times: Sequence[float]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Positions and speeds at the times that the run lives to see."""
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    with suppress(ts.NumericalFailure):
        for time in times:
            seen.append(_after(run, time))
    return seen


def _after(run: Simulation, time: float) -> tuple[np.ndarray, np.ndarray]:
    run.advance(time)
    speed = torch.linalg.norm(run.particles.velocity, dim=1) * run.units.speed
    return (run.particles.position * run.units.length).double().numpy(), speed.double().numpy()


def _energy(points: np.ndarray, speed: np.ndarray) -> float:
    """Kinetic and potential energy of particles of equal mass, J/kg."""
    return float((speed**2 / 2 + GRAVITY * points[:, 1]).mean())


def _gap(points: np.ndarray, spacing: float) -> float:
    """Distance (spacings) from the wedge's sides that a twentieth of the particles near it stays within."""
    tip, slope = TANK[2], TANK[2] - TANK[1]
    normal = np.array([slope[1], slope[0]]) / np.linalg.norm(slope)
    mirrored = np.stack([np.abs(points[:, 0] - tip[0]), points[:, 1] - tip[1]], 1)
    along = mirrored @ (np.array([slope[0], -slope[1]]) / np.linalg.norm(slope))
    beside = (along > 0.05 * np.linalg.norm(slope)) & (along < 0.6 * np.linalg.norm(slope))
    away = (mirrored @ normal)[beside]
    return float(np.quantile(away[away < 4 * spacing], 0.05) / spacing)
