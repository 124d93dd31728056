"""Schemes by name."""

from __future__ import annotations

from dataclasses import replace

from .incompressible import Projection
from .schemes import XSPH, PotentialWall, PressureSource, WeaklyCompressible

Scheme = WeaklyCompressible | Projection

# 16 particles per cell of table 4.1 put a spacing at cell / 16^(1/3); the support of the truncated Gaussian (delta 3)
# is one cell, so h = cell / 3
_THESIS_RATIO = 16 ** (1 / 3) / 3

PRESETS: dict[str, Scheme] = {
    "default": WeaklyCompressible(
        artificial_viscosity=None, density_diffusion=0.2, shifting=4.0, shifting_speed="largest", courant=0.5,
    ),
    "projection": Projection(),
    "thesis": WeaklyCompressible(
        kernel="gaussian", smoothing_ratio=_THESIS_RATIO, sound_speed=5.0, gamma=3.0, background_pressure=0.2,
        continuity="mass", pressure="symmetric", artificial_viscosity=0.5, laminar_viscosity=False,
        density_diffusion=None, xsph=XSPH(0.2, "velocity"), shifting=None, bulk_damping=None, shepard_period=50,
        wall=PotentialWall(), valve=PressureSource(), order="thesis", steps_per_frame=100,
    ),
}


def preset(name: str, **changes: object) -> Scheme:
    """The preset called ``name``, with some options changed.

    "default" is weakly compressible, "projection" incompressible, "thesis" table 4.1. What chose the components of the
    default is measured in ``examples/benchmarks/preset.py``.
    """
    if name not in PRESETS:
        raise ValueError(f"unknown preset '{name}'; known: {', '.join(sorted(PRESETS))}")
    return replace(PRESETS[name], **changes) if changes else PRESETS[name]
