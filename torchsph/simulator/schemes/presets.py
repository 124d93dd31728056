"""Schemes by name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from geometry.arguments import checked

from .parts import XSPH
from .projection import Projection
from .scheme import Scheme
from .valve_models import PressureSource
from .wall_models import PotentialWall
from .weakly_compressible import WeaklyCompressible

# 16 particles per cell (Grønli 2017, table 4.1) put a spacing at cell / 16^(1/3); the support of the truncated Gaussian
# (delta 3) is one cell, so h = cell / 3
_THESIS_RATIO = 16 ** (1 / 3) / 3

# Incompressible steps, for flow that fills a heart's chamber. Error over persistence's on a ventricle at 1 mm, 5 / 10 /
# 20 / 40 ms ahead: .57 / .48 / .40 / .34 with steps of up to 0.7 ms; .59 / .50 / .41 / .35 with 1 ms at 0.75 times the
# cost; weakly compressible .57 / .47 / .40 / .34 at 2.5 times. A slower relaxation stirs the fluid less, in pipes and
# vortices (``validation.PERIODIC_PROJECTION``), but leaves a jet that fills a widening tube less even: error .076 with
# 2, .087 with 3, .103 with 6 spacings per reference speed, in a pipe of 10 spacings .0050, .0041 and .0033.
_PROJECTION = Projection(max_step=7e-4, courant=0.4, tolerance=1.25e-2, relaxation=3.0)

PRESETS: dict[str, Scheme] = {
    "default": _PROJECTION,
    "projection": _PROJECTION,
    "weakly_compressible": WeaklyCompressible(
        artificial_viscosity=None,
        density_diffusion=0.2,
        shifting=4.0,
        shifting_speed="largest",
        courant=0.5,
    ),
    "thesis": WeaklyCompressible(
        kernel="gaussian",
        smoothing_ratio=_THESIS_RATIO,
        sound_speed=5.0,
        gamma=3.0,
        background_pressure=0.2,
        continuity="mass",
        pressure="symmetric",
        artificial_viscosity=0.5,
        laminar_viscosity=False,
        density_diffusion=None,
        xsph=XSPH(0.2, "velocity"),
        shifting=None,
        bulk_damping=None,
        shepard_period=50,
        wall=PotentialWall(),
        valve=PressureSource(),
        order="thesis",
        steps_per_frame=100,
    ),
}


@checked
def preset(name: str, **changes: Any) -> Scheme:
    """The preset called ``name``, with some options changed.

    "default" is what the command line and the pipelines take: "projection", incompressible, for flow that fills its
    walls. "weakly_compressible" is for every scene, and what a ``Simulator`` takes that is not told; what chose its
    components is measured in ``examples/benchmarks/preset.py``. "thesis" is that of Grønli 2017, table 4.1.
    """
    if name not in PRESETS:
        raise ValueError(f"unknown preset '{name}'; known: {', '.join(sorted(PRESETS))}")
    return replace(PRESETS[name], **changes) if changes else PRESETS[name]
