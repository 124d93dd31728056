"""Types of the changes to the schemes' options that flows need which the presets were not chosen for."""

from __future__ import annotations

from typing import TypedDict

from torchsph.simulator.schemes.wall_models import CompleteKernelWall


class WeaklyCompressibleOptions(TypedDict, total=False):
    """Some options of ``WeaklyCompressible``."""

    smoothing_ratio: float
    sound_speed: float
    pressure: str
    least_density: float | None
    artificial_viscosity: float | None
    density_diffusion: float | None
    bulk_damping: float | None
    shifting: float | None
    shifting_speed: str
    shifting_surface: float | None
    order: str
    constant_volume: bool
    wall: CompleteKernelWall


class ProjectionOptions(TypedDict, total=False):
    """Some options of ``Projection``."""

    relaxation: float | None
    shifting: float | None
    courant: float
    tolerance: float
    max_step: float | None
    longest_step: float | None
