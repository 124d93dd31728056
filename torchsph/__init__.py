"""torchsph: noisy ultrasound measurements of the flow in the heart, turned into consistent velocity fields.

An SPH simulator, incompressible or weakly compressible, is the forecast model, a penalised B-spline smoother its rival,
and an ensemble filter joins forecasts and measurements.

A public name is imported when it is first asked for: importing the package takes no time, and torch is loaded by what
needs it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .methods.between_frames import BetweenFrames
    from .methods.by_name import DEFAULT_METHOD, METHODS, MethodResult, forecast_skill, make_model, run_methods
    from .methods.ensemble.assimilate import EnsembleRun, assimilate, default_filter
    from .methods.ensemble.options import EnsembleOptions, Estimated
    from .methods.forecast_skill import ForecastSkill, skill
    from .methods.measurement.error_model import ObservationError, estimate_error
    from .methods.measurement.frame_splines import smooth
    from .methods.measurement.over_time import AveragedOverTime, average_over_time
    from .methods.measurement.prepared import PreparedMeasurement as PreparedMeasurement
    from .methods.nudging import FilteredRun, filter_sph
    from .methods.resample import resample
    from .pairs.smoothing_kernels import KERNELS, SmoothingKernel, kernel
    from .report.write import write_report
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
    from .simulator.transfer.particle_series import ParticleSeries

__version__ = "0.1.0"  # the one place: pyproject.toml reads it from here, without importing

__all__ = [
    "DEFAULT_METHOD",
    "KERNELS",
    "METHODS",
    "PRESETS",
    "XSPH",
    "AveragedOverTime",
    "BetweenFrames",
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
    "ParticleSeries",
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
    "average_over_time",
    "default_filter",
    "estimate_error",
    "filter_sph",
    "forecast_skill",
    "kernel",
    "make_model",
    "preset",
    "resample",
    "residual_motion",
    "run_methods",
    "skill",
    "smooth",
    "write_report",
]

# where each public name lives, as the imports above have it
_HOMES = {
    "methods.between_frames": ("BetweenFrames",),
    "methods.by_name": (
        "DEFAULT_METHOD",
        "METHODS",
        "MethodResult",
        "forecast_skill",
        "make_model",
        "run_methods",
    ),
    "methods.ensemble.assimilate": (
        "EnsembleRun",
        "assimilate",
        "default_filter",
    ),
    "methods.ensemble.options": (
        "EnsembleOptions",
        "Estimated",
    ),
    "methods.forecast_skill": (
        "ForecastSkill",
        "skill",
    ),
    "methods.measurement.error_model": (
        "ObservationError",
        "estimate_error",
    ),
    "methods.measurement.frame_splines": ("smooth",),
    "methods.measurement.over_time": (
        "AveragedOverTime",
        "average_over_time",
    ),
    "methods.measurement.prepared": ("PreparedMeasurement",),
    "methods.nudging": (
        "FilteredRun",
        "filter_sph",
    ),
    "methods.resample": ("resample",),
    "pairs.smoothing_kernels": (
        "KERNELS",
        "SmoothingKernel",
        "kernel",
    ),
    "report.write": ("write_report",),
    "simulator.failures": ("NumericalFailure",),
    "simulator.grid_forecast": (
        "GridForecast",
        "Transfer",
    ),
    "simulator.residual_motion": (
        "ResidualMotion",
        "residual_motion",
    ),
    "simulator.scene": (
        "Fluid",
        "Scene",
        "Valve",
    ),
    "simulator.schemes.parts": (
        "XSPH",
        "GammaRamp",
        "Rollback",
    ),
    "simulator.schemes.population_control": ("PopulationControl",),
    "simulator.schemes.presets": (
        "PRESETS",
        "preset",
    ),
    "simulator.schemes.projection": ("Projection",),
    "simulator.schemes.valve_models": (
        "PressureSource",
        "Reservoir",
    ),
    "simulator.schemes.wall_models": (
        "CompleteKernelWall",
        "PotentialWall",
    ),
    "simulator.schemes.weakly_compressible": ("WeaklyCompressible",),
    "simulator.seeding": ("Seeding",),
    "simulator.simulation": ("Simulation",),
    "simulator.simulator": ("Simulator",),
    "simulator.transfer.particle_series": ("ParticleSeries",),
}

_ROOMS = (
    "assimilation",
    "cli",
    "data",
    "evaluation",
    "haemodynamics",
    "methods",
    "native",
    "pairs",
    "report",
    "simulator",
    "ultrasound",
    "validation",
)


def __getattr__(name: str) -> object:
    """A public name or a room of the package, imported when it is first asked for (PEP 562)."""
    home = next((home for home, names in _HOMES.items() if name in names), None)
    if home is not None:
        found: object = getattr(import_module(f"{__name__}.{home}"), name)
    elif name in _ROOMS:
        found = import_module(f"{__name__}.{name}")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """What the package offers, imported already or not."""
    return sorted({*globals(), *__all__, *_ROOMS})
