"""torchsph: noisy ultrasound measurements of the flow in the heart, turned into consistent velocity fields.

A weakly compressible SPH simulator is the forecast model, a penalised B-spline smoother its rival, and an ensemble
filter joins forecasts and measurements.
"""

from ._version import __version__
from .ensemble import EnsembleOptions, EnsembleRun, assimilate, default_filter
from .forecast import ForecastSkill, GridForecast, Transfer, skill
from .observation_error import ObservationError, estimate_error
from .particle_filter import FilteredRun, filter_sph
from .pipeline import DEFAULT_METHOD, METHODS, MethodResult, forecast_skill, make_model, run_methods
from .scene import Fluid, Scene, Valve
from .schemes import (
    PRESETS,
    XSPH,
    CompleteKernelWall,
    GammaRamp,
    PotentialWall,
    PressureSource,
    Reservoir,
    Rollback,
    WeaklyCompressible,
    preset,
)
from .seeding import Seeding
from .simulation import NumericalFailure, Simulation
from .simulator import Simulator
from .smooth import smooth
from .smoothing import KERNELS, SmoothingKernel, kernel

__all__ = [
    "DEFAULT_METHOD", "KERNELS", "METHODS", "PRESETS", "XSPH", "CompleteKernelWall", "EnsembleOptions", "EnsembleRun",
    "FilteredRun", "Fluid", "ForecastSkill", "GammaRamp", "GridForecast", "MethodResult", "NumericalFailure",
    "ObservationError", "PotentialWall", "PressureSource", "Reservoir", "Rollback", "Scene", "Seeding", "Simulation",
    "Simulator", "SmoothingKernel", "Transfer", "Valve", "WeaklyCompressible", "__version__", "assimilate",
    "default_filter", "estimate_error", "filter_sph", "forecast_skill", "kernel", "make_model", "preset",
    "run_methods", "skill", "smooth",
]  # fmt: skip
