"""Particles during filling with the thesis's settings, with cures, and as they are now (Grønli 2017, fig. 5.1)."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

import torchsph as ts
from torchsph.simulator.schemes.scheme import Scheme

from ..material import Material
from ..record import Claim, Result
from ..style import axes, planes

START, DURATION = 0.28, 0.04  # s: from the E wave's rise to past its peak


def schemes() -> dict[str, Scheme]:
    """The thesis's preset, what cures it one by one, and the default."""
    return {
        "thesis": ts.preset("thesis"),
        "+ stiffer (c = 15 m/s)": ts.preset("thesis", sound_speed=15.0, background_pressure=0.02, steps_per_frame=None),
        "+ reservoirs, complete walls": ts.preset(
            "weakly_compressible", artificial_viscosity=0.5, shifting=None, xsph=ts.XSPH(0.2, "position")
        ),
        "default": ts.preset("default"),
    }


def make(material: Material) -> Result:
    """Distances between particles, and nodes that no particle covers, after the E wave."""
    truth = material.truth
    spacing = (3.0 if material.fast else 1.5) * 1e-3
    scene = material.scene(spacing)
    first = int(np.abs(truth.time - START).argmin())
    last = int(np.abs(truth.time - START - DURATION).argmin())
    numbers, shown = {}, {}
    chosen = schemes()
    for name in ("thesis", "default") if material.fast else chosen:
        numbers[name], shown[name] = _after_filling(ts.Simulator(scene, chosen[name]), material, first, last)
    worst, cured = numbers["thesis"], numbers["default"]
    claims = [
        Claim(
            "particles cluster under high pressure during filling",
            worst["nearest_neighbour_p05"] < 0.6 * cured["nearest_neighbour_p05"],
            f"a twentieth of the particles is nearer than {worst['nearest_neighbour_p05']:.2f} spacings to another "
            f"with the thesis's settings, {cured['nearest_neighbour_p05']:.2f} now",
        ),
        Claim(
            "velocities cannot be fetched where support is missing (vacuum near the inlet, clusters)",
            worst["uncovered"] > 0.01,
            f"{100 * worst['uncovered']:.1f} % of the nodes uncovered with the thesis's settings at "
            f"{1e3 * worst['time']:.0f} ms, {100 * cured['uncovered']:.1f} % now at {1e3 * cured['time']:.0f} ms; "
            f"the particles' volume is {100 * worst['volume_error']:.0f} % and {100 * cured['volume_error']:.0f} % off",
        ),
    ]

    def draw() -> Figure:
        plane = planes(truth)[0]
        figure, panels = axes(1, len(shown), 2.5 * len(shown), 4.2)
        normal = np.cross(plane.across, plane.along)
        for axis, (name, points) in zip(panels[0], shown.items(), strict=True):
            offset = points - plane.origin
            slab = np.abs(offset @ normal) < spacing
            axis.scatter(1e3 * (offset @ plane.across)[slab], 1e3 * (offset @ plane.along)[slab], s=6, color="k")
            s0, s1, t0, t1 = (1e3 * e for e in plane.extent)
            axis.set(aspect="equal", xlim=(s0, s1), ylim=(t0, t1 + 3), xticks=[], yticks=[])
            axis.set_title(f"{name}\nuncovered {100 * numbers[name]['uncovered']:.1f} %", fontsize=8)
        return figure

    settings = material.settings(spacing_m=spacing, start_s=START, duration_s=DURATION)
    return Result(numbers, claims, settings, draw)


def _after_filling(model: ts.Simulator, material: Material, first: int, last: int) -> tuple[dict, np.ndarray]:
    """Numbers of the particles at the last frame, and their places, m."""
    truth = material.truth
    run = model.start(float(truth.time[first]), seed=material.seed)
    mask = torch.from_numpy(np.array(truth.mask[first], bool))
    run.impose(truth.grid, torch.from_numpy(np.nan_to_num(truth.velocity[first])), mask)
    failure = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of lost volume: a number here
        try:
            run.advance(float(truth.time[last]))
        except ts.NumericalFailure as fault:  # the last good state is what is looked at
            failure = str(fault)
    wanted = torch.from_numpy(np.array(truth.mask[last], bool))
    found = run.fetch(truth.grid, wanted)
    inside = run.particles.position[run.particles.inside].double().numpy()
    nearest = cKDTree(inside).query(inside, k=2)[0][:, 1]
    around = np.array([len(one) for one in cKDTree(inside).query_ball_point(inside, 2.0)])
    numbers = {
        "particles": len(inside),
        "uncovered": float((wanted & ~found.covered[0]).sum() / wanted.sum()),
        "nearest_neighbour_p05": float(np.quantile(nearest, 0.05)),
        "nearest_neighbour_median": float(np.median(nearest)),
        "variation_of_concentration": float(around.std() / around.mean()),
        "volume_error": float(run.record.volume_error.max()),
        "time": run.time,
        "failure": failure,
    }
    return numbers, inside * run.units.length
