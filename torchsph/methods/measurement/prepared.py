"""A recording with all that is derived from it alone, each part made once, when it is first asked for."""

from __future__ import annotations

from functools import cached_property

import numpy as np

import geometry
import regularize

from .error_model import ObservationError, estimate_error
from .frame_splines import FrameSmoother, smooth_frames
from .wall_balance import WallBalance, amplitude_error


class PreparedMeasurement:
    """A measurement with its splines, the field that they make and its error model.

    Every method takes one in the place of a recording; methods that share it share the work. Under
    ``torch.distributed`` all processes share the splines of ``smoothed``, so all of them have to ask for it.

    Attributes:
        recording: the measurement, with walls and valve times as far as they can be believed (``geometry.estimated``).

    Args:
        recording: the measurement.
        smoother: options of its splines; None takes the default ones.
        splines: the fits, where they are there already (then ``smoother`` is theirs).
        smoothed: their result on the recording's grid, where it is there already.
        error: the error model, where it is known.
        progress: show a bar while splines are fitted.
    """

    def __init__(
        self,
        recording: geometry.Recording,
        smoother: regularize.Smoother | None = None,
        *,
        splines: FrameSmoother | None = None,
        smoothed: geometry.Recording | None = None,
        error: ObservationError | None = None,
        progress: bool = False,
    ) -> None:
        if splines is not None and smoother is not None:
            raise ValueError("PreparedMeasurement takes a smoother or splines, which have one already, not both")
        self.progress = progress
        if splines is None:
            splines = FrameSmoother(recording, regularize.Smoother() if smoother is None else smoother)
            splines.warn()
        self.splines, self.recording = splines, splines.recording
        self.type = geometry.measurement_type(self.recording)
        if smoothed is not None:
            self.__dict__["smoothed"] = smoothed  # where a cached property keeps what it has found
        if error is not None:
            self.__dict__["error"] = error

    @classmethod
    def of(cls, measured: geometry.Recording | PreparedMeasurement, *, progress: bool = False) -> PreparedMeasurement:
        """What was prepared already stays as it is."""
        return measured if isinstance(measured, PreparedMeasurement) else cls(measured, progress=progress)

    @cached_property
    def smoothed(self) -> geometry.Recording:
        """The splines on the recording's grid, mask and times."""
        return smooth_frames(self.splines, self.progress)

    @cached_property
    def error(self) -> ObservationError:
        """How wrong the measurement is, from what its splines leave over."""
        return estimate_error(self.recording, self.splines, self.smoothed)

    @cached_property
    def balance(self) -> WallBalance | None:
        """Of mass between the walls; None without walls, where the velocities contradict them, or in a cut plane."""
        motion = self.splines.motion
        if self.recording.cut:  # what passes through it is not known
            return None
        return None if motion is None or self.splines.estimates.contradicted else WallBalance(self.recording, motion)

    @cached_property
    def amplitude_error(self) -> float:
        """How wrong amplitudes found in this measurement are, relative: what its splines miss of the known flow."""
        return 0.0 if self.balance is None else amplitude_error(self.balance, self.smoothed)

    @cached_property
    def reference_speed(self) -> float:
        """RMS per component of the splines over the mask, m/s: what is a usual speed in this flow."""
        inside = np.moveaxis(self.smoothed.velocity, 1, -1)[np.asarray(self.recording.mask, bool)]
        return float(np.sqrt(np.mean(np.square(inside, dtype=np.float64))))
