"""torchsph: noisy ultrasound measurements of the flow in the heart, turned into consistent velocity fields.

An SPH simulator, incompressible or weakly compressible, is the forecast model, a penalised B-spline smoother its rival,
and an ensemble filter joins forecasts and measurements.
"""

from ._version import __version__
from .ensemble import EnsembleRun, assimilate, default_filter
from .ensemble_options import EnsembleOptions, Estimated
from .forecast import ForecastSkill, GridForecast, Transfer, skill
from .incompressible import Projection
from .observation_error import ObservationError, estimate_error
from .particle_filter import FilteredRun, filter_sph
from .pipeline import DEFAULT_METHOD, METHODS, MethodResult, forecast_skill, make_model, run_methods
from .population import PopulationControl
from .presets import PRESETS, preset
from .scene import Fluid, Scene, Valve
from .schemes import (
    XSPH,
    CompleteKernelWall,
    GammaRamp,
    PotentialWall,
    PressureSource,
    Reservoir,
    Rollback,
    WeaklyCompressible,
)
from .seeding import ResidualMotion, Seeding, residual_motion
from .simulation import NumericalFailure, Simulation
from .simulator import Simulator
from .smooth import smooth
from .smoothing import KERNELS, SmoothingKernel, kernel

__all__ = [
    "DEFAULT_METHOD",
    "KERNELS",
    "METHODS",
    "PRESETS",
    "XSPH",
    "CompleteKernelWall",
    "EnsembleOptions",
    "EnsembleRun",
    "Estimated",
    "FilteredRun",
    "Fluid",
    "ForecastSkill",
    "GammaRamp",
    "GridForecast",
    "MethodResult",
    "NumericalFailure",
    "ObservationError",
    "PopulationControl",
    "PotentialWall",
    "PressureSource",
    "Projection",
    "Reservoir",
    "ResidualMotion",
    "Rollback",
    "Scene",
    "Seeding",
    "Simulation",
    "Simulator",
    "SmoothingKernel",
    "Transfer",
    "Valve",
    "WeaklyCompressible",
    "__version__",
    "assimilate",
    "default_filter",
    "estimate_error",
    "filter_sph",
    "forecast_skill",
    "kernel",
    "make_model",
    "preset",
    "residual_motion",
    "run_methods",
    "skill",
    "smooth",
]
