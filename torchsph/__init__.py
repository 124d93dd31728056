"""torchsph: noisy ultrasound measurements of the flow in the heart, turned into consistent velocity fields.

An SPH simulator, incompressible or weakly compressible, is the forecast model, a penalised B-spline smoother its rival,
and an ensemble filter joins forecasts and measurements.
"""

from .methods.by_name import DEFAULT_METHOD, METHODS, MethodResult, forecast_skill, make_model, run_methods
from .methods.ensemble.assimilate import EnsembleRun, assimilate, default_filter
from .methods.ensemble.options import EnsembleOptions, Estimated
from .methods.forecast_skill import ForecastSkill, skill
from .methods.measurement.error_model import ObservationError, estimate_error
from .methods.measurement.frame_splines import smooth
from .methods.measurement.prepared import PreparedMeasurement as PreparedMeasurement
from .methods.nudging import FilteredRun, filter_sph
from .pairs.smoothing_kernels import KERNELS, SmoothingKernel, kernel
from .simulator.failures import NumericalFailure
from .simulator.grid_forecast import GridForecast, Transfer
from .simulator.residual_motion import ResidualMotion, residual_motion
from .simulator.scene import Fluid, Scene, Valve
from .simulator.schemes.parts import XSPH, GammaRamp, Rollback
from .simulator.schemes.population_control import PopulationControl
from .simulator.schemes.presets import PRESETS, preset
from .simulator.schemes.projection import Projection
from .simulator.schemes.valve_models import PressureSource, Reservoir
from .simulator.schemes.wall_models import CompleteKernelWall, PotentialWall
from .simulator.schemes.weakly_compressible import WeaklyCompressible
from .simulator.seeding import Seeding
from .simulator.simulation import Simulation
from .simulator.simulator import Simulator

__version__ = "0.1.0"  # the one place: pyproject.toml reads it from here, without importing

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
