"""Ultrasound: from flow to echoes and back to velocities, and a noise model of the whole for sweeps.

The simulated scanner (`scanner`) and the estimators (`estimation`) meet in the IQ packets of `acquisition` alone:
neither imports the other. `measurements` joins the two on a recording.
"""

from .acquisition import Acquisition, Beams, Packet
from .estimation.clutter import ClutterFilter, FIRFilter, PolynomialFilter, SVDFilter
from .estimation.doppler import ColourDoppler, DopplerEstimates, colour_doppler, vector_doppler
from .estimation.estimates import Estimates, Flag
from .estimation.plugin import LibraryTracker, Tracker
from .estimation.tracking import SpeckleTracker, track
from .measurements.calibration import Calibration, fit_calibration
from .measurements.doppler import DopplerOptions, measure_doppler
from .measurements.noise import NoiseModel, measure_noise
from .measurements.speckle import SpeckleOptions, measure_speckle
from .measurements.training import SwirlFlow, TrainingPlan, calibrate, random_scene, random_swirl
from .scanner.echoes import EchoModel, simulate_packet
from .scanner.flow import Flow, LinearFlow, RecordingFlow
from .scanner.pointspread import GaussianPointSpread, PointSpread, SampledPointSpread, SectorPointSpread
from .uff import UffVolumes, read_uff, write_uff

__all__ = [
    "Acquisition",
    "Beams",
    "Calibration",
    "ClutterFilter",
    "ColourDoppler",
    "DopplerEstimates",
    "DopplerOptions",
    "EchoModel",
    "Estimates",
    "FIRFilter",
    "Flag",
    "Flow",
    "GaussianPointSpread",
    "LibraryTracker",
    "LinearFlow",
    "NoiseModel",
    "Packet",
    "PointSpread",
    "PolynomialFilter",
    "RecordingFlow",
    "SVDFilter",
    "SampledPointSpread",
    "SectorPointSpread",
    "SpeckleOptions",
    "SpeckleTracker",
    "SwirlFlow",
    "Tracker",
    "TrainingPlan",
    "UffVolumes",
    "calibrate",
    "colour_doppler",
    "fit_calibration",
    "measure_doppler",
    "measure_noise",
    "measure_speckle",
    "random_scene",
    "random_swirl",
    "read_uff",
    "simulate_packet",
    "track",
    "vector_doppler",
    "write_uff",
]
