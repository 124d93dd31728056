"""Ultrasound: from flow to echoes and back to velocities, and a noise model of the whole for sweeps.

The simulated scanner (`scanner`), the beamformer of channel data (`beamforming`) and the estimators (`estimation`)
meet in the IQ packets of `acquisition` alone: none imports another. `measurements` joins the first and the last on a
recording.
"""

from .acquisition import Acquisition, Beams, IQPhase, Packet
from .beamforming.channel_data import ChannelData, convex_array
from .beamforming.delay_and_sum import DelayAndSum, delay_and_sum
from .beamforming.demodulation import demodulated
from .beamforming.read_channel_data import read_channel_data, read_transmissions
from .estimation.clutter import ClutterFilter, FIRFilter, PolynomialFilter, SVDFilter
from .estimation.doppler import ColourDoppler, DopplerEstimates, colour_doppler, vector_doppler
from .estimation.estimates import Estimates, Flag
from .estimation.plugin import LibraryTracker, Tracker
from .estimation.tracking import SpeckleTracker, track
from .measurements.aliasing import aliased
from .measurements.calibration import Calibration, fit_calibration
from .measurements.doppler import DopplerOptions, measure_doppler
from .measurements.noise import NoiseModel, measure_noise
from .measurements.speckle import SpeckleOptions, measure_speckle
from .measurements.tracked import TrackingPlan, read_uff_recording, track_recording
from .measurements.training import SwirlFlow, TrainingPlan, calibrate, random_scene, random_swirl
from .phase import PhaseSlope, baseband, phase_slope
from .scanner.echoes import EchoModel, simulate_packet
from .scanner.flow import Flow, LinearFlow, RecordingFlow
from .scanner.pointspread import GaussianPointSpread, PointSpread, SampledPointSpread, SectorPointSpread
from .uff import UffVolumes, read_uff, write_uff

__all__ = [
    "Acquisition",
    "Beams",
    "Calibration",
    "ChannelData",
    "ClutterFilter",
    "ColourDoppler",
    "DelayAndSum",
    "DopplerEstimates",
    "DopplerOptions",
    "EchoModel",
    "Estimates",
    "FIRFilter",
    "Flag",
    "Flow",
    "GaussianPointSpread",
    "IQPhase",
    "LibraryTracker",
    "LinearFlow",
    "NoiseModel",
    "Packet",
    "PhaseSlope",
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
    "TrackingPlan",
    "TrainingPlan",
    "UffVolumes",
    "aliased",
    "baseband",
    "calibrate",
    "colour_doppler",
    "convex_array",
    "delay_and_sum",
    "demodulated",
    "fit_calibration",
    "measure_doppler",
    "measure_noise",
    "measure_speckle",
    "phase_slope",
    "random_scene",
    "random_swirl",
    "read_channel_data",
    "read_transmissions",
    "read_uff",
    "read_uff_recording",
    "simulate_packet",
    "track",
    "track_recording",
    "vector_doppler",
    "write_uff",
]
