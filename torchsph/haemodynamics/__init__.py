"""What people read out of a flow: vorticity, energy, forces, flow rates, vortices, pressure, transit of blood.

Pure functions of arrays (velocity, mask, spacing, walls) in SI units; formulas and sources stand above each and in
`README.md` here.
"""

from .beat import BEAT_UNITS, CUT_BEAT_UNITS, PLANE_BEAT_UNITS, beat_numbers, plane_beat_numbers
from .circulation import PlaneCirculation, contour_circulation, plane_circulation
from .domain import FieldQuantities, FlowDomain, long_axis
from .energy import dissipation, energy_loss, integral, kinetic_energy, kinetic_energy_density
from .fields.acceleration import material_acceleration, pressure_gradient, time_derivative
from .fields.derivatives import Derivatives, WallSamples
from .fields.sampling import PlaneSection, plane_section, sample_in_mask
from .flow_rate import (
    FillingPeaks,
    OpeningFlow,
    e_and_a,
    plane_flow,
    regurgitant_fraction,
    regurgitant_volume,
    stroke_volume,
)
from .force import axial_components, haemodynamic_force
from .lagrangian.flow_components import FlowComponents, flow_components
from .lagrangian.moving_flow import MovingFlow, MovingWalls
from .lagrangian.tracers import Tracers, carry, residence_time, seed_blood
from .plane_quantities import CUT_UNITS, PLANE_UNITS, PlaneQuantities
from .pressure import PressureSolver, pressure_difference, region_mean
from .quantities import UNITS, Catalogue, FrameQuantities, catalogue, flow_quantities
from .uncertainty import RunningMoments, Summary, around, coverage, summary, unresolved
from .vortices import PlaneCore, PlaneVortex, VortexRing, main_vortex, plane_cores, vortex_cores, vortex_ring
from .vorticity import helicity_density, lambda2, q_criterion, swirl, vorticity
from .wall_shear import WallShear

__all__ = [
    "BEAT_UNITS",
    "CUT_BEAT_UNITS",
    "CUT_UNITS",
    "PLANE_BEAT_UNITS",
    "PLANE_UNITS",
    "UNITS",
    "Catalogue",
    "Derivatives",
    "FieldQuantities",
    "FillingPeaks",
    "FlowComponents",
    "FlowDomain",
    "FrameQuantities",
    "MovingFlow",
    "MovingWalls",
    "OpeningFlow",
    "PlaneCirculation",
    "PlaneCore",
    "PlaneQuantities",
    "PlaneSection",
    "PlaneVortex",
    "PressureSolver",
    "RunningMoments",
    "Summary",
    "Tracers",
    "VortexRing",
    "WallSamples",
    "WallShear",
    "around",
    "axial_components",
    "beat_numbers",
    "carry",
    "catalogue",
    "contour_circulation",
    "coverage",
    "dissipation",
    "e_and_a",
    "energy_loss",
    "flow_components",
    "flow_quantities",
    "haemodynamic_force",
    "helicity_density",
    "integral",
    "kinetic_energy",
    "kinetic_energy_density",
    "lambda2",
    "long_axis",
    "main_vortex",
    "material_acceleration",
    "plane_beat_numbers",
    "plane_circulation",
    "plane_cores",
    "plane_flow",
    "plane_section",
    "pressure_difference",
    "pressure_gradient",
    "q_criterion",
    "region_mean",
    "regurgitant_fraction",
    "regurgitant_volume",
    "residence_time",
    "sample_in_mask",
    "seed_blood",
    "stroke_volume",
    "summary",
    "swirl",
    "time_derivative",
    "unresolved",
    "vortex_cores",
    "vortex_ring",
    "vorticity",
]
