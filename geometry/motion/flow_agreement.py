"""Whether the velocities measured at the openings and the walls' motion tell of the same flow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.recordings.recording import Recording

from .valve_times import ValveTimes, measured_flow
from .wall_motion import WallMotion

# velocities that are blurred, or thinned out by a clutter filter, tell .6 to 1.05 of a flow whose walls are right ...
_LEAST, _MOST = 0.5, 1.5
# ... and a ratio means something where its error is this many times smaller than what it is off by
_DEVIATIONS = 3.0
_FEWEST = 4  # frames
# less than this part of the walls' flow is none: nobody has measured at the openings
_NONE = 0.01


@dataclass(frozen=True)
class FlowAgreement:
    """The flow through the open openings by the measured velocities, over dV/dt by the walls.

    Attributes:
        ratio: slope of the one over the other, through nought, over the frames in which all open openings are seen.
        error: its standard deviation.
        frames: their number.
    """

    ratio: float
    error: float
    frames: int

    @property
    def contradicts(self) -> bool:
        """Whether the two differ by more than blur and noise explain."""
        beyond = max(_LEAST - self.ratio, self.ratio - _MOST)
        return beyond > _DEVIATIONS * self.error

    def words(self) -> str:
        """One sentence for a person."""
        return (
            f"the velocities at the openings pass {self.ratio:.2g} times (+- {self.error:.2g}) what the walls' dV/dt "
            f"asks for, over {self.frames} frames: both are weighed; look at the units, the openings' labels and the "
            "segmentation"
        )


def flow_agreement(recording: Recording, valves: ValveTimes) -> FlowAgreement | None:
    """Compare velocities and walls; None where walls move nothing, or where too little is seen to tell.

    Args:
        recording: with walls, whose motion is estimated already.
        valves: when its openings are open.
    """
    seen_whole = recording.beam is None and recording.normal is None
    if not seen_whole or recording.wall is None or not recording.wall.moves:
        return None
    motion = WallMotion.from_recording(recording)
    rate = np.array([motion.volume_rate(float(t)) for t in recording.time])
    labels = sorted({int(label) for label in recording.wall.region if label > 0})
    flow, any_open = np.zeros(recording.frames), np.zeros(recording.frames, bool)
    for label in labels:
        rows = valves.intervals[valves.intervals[:, 0] == label]
        is_open = ((rows[:, 1:2] <= recording.time) & (recording.time < rows[:, 2:3])).any(0)
        value, _ = measured_flow(recording, motion, label)
        flow, any_open = flow + np.where(is_open, value, 0.0), any_open | is_open
    seen = any_open & np.isfinite(flow)
    power = float((rate[seen] ** 2).sum())
    if int(seen.sum()) < _FEWEST or power == 0.0:
        return None
    ratio = float((flow[seen] * rate[seen]).sum()) / power
    if abs(ratio) < _NONE:
        return None
    left = float(((flow[seen] - ratio * rate[seen]) ** 2).sum()) / (int(seen.sum()) - 1)
    return FlowAgreement(ratio, float(np.sqrt(left / power)), int(seen.sum()))
