"""A recording as it can be believed: walls without flicker, valves that are open when something flows."""

from __future__ import annotations

from dataclasses import dataclass

from geometry.arguments import checked
from geometry.recordings.recording import Recording

from .flow_agreement import FlowAgreement, flow_agreement
from .valve_times import ValveTimes, find_valve_times
from .wall_estimate import WallEstimate, estimate_wall


@dataclass(frozen=True, eq=False)
class Estimates:
    """What was estimated of a recording's walls and valves.

    Attributes:
        recording: with the estimated walls and valve times; the given one where nothing was to mend.
        wall: motion of the walls, or None without walls.
        valves: times of the valves, or None without walls.
        flow: whether velocities and walls tell of the same flow; None where that cannot be told.
    """

    recording: Recording
    wall: WallEstimate | None
    valves: ValveTimes | None
    flow: FlowAgreement | None = None

    @property
    def contradicted(self) -> bool:
        """Whether the velocities tell of another flow than the walls."""
        return self.flow is not None and self.flow.contradicts

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for everything that is not as the file has it."""
        found = () if self.wall is None or not self.wall.uncertain else (self.wall.words(),)
        found = found if self.valves is None else (*found, *self.valves.changes)
        return found if self.flow is None or not self.flow.contradicts else (*found, self.flow.words())

    def summary(self) -> dict[str, object]:
        """What was found, for `metrics.json`: SI units; {} where the file stands as it is."""
        result: dict[str, object] = {}
        if self.wall is not None and self.wall.uncertain:
            result["wall"] = {
                "noise_m": self.wall.noise,
                "remaining_m": float(self.wall.sigma.mean()),
                "volume_jitter_m3": self.wall.volume_jitter,
                "rate_jitter_m3_per_s": self.wall.rate_jitter,
                "rate_sigma_m3_per_s": float(self.wall.rate_sigma.mean()),
            }
        if self.valves is not None and self.valves.source != "given":
            result["valves"] = {
                "source": self.valves.source,
                "intervals_s": self.valves.intervals.tolist(),
                "error_s": self.valves.error.tolist(),
            }
        if self.flow is not None and self.flow.contradicts:
            result["flow"] = {
                "velocities_over_walls": self.flow.ratio,
                "error": self.flow.error,
                "frames": self.flow.frames,
            }
        return result


@checked
def estimated(recording: Recording) -> Estimates:
    """Estimate the wall motion (``estimate_wall``) and the valve times (``find_valve_times``) of a recording.

    Exact walls and times that can be so come back as they are, bit for bit. Velocities that are NaN, where nothing was
    measured, stay so.
    """
    if recording.wall is None:
        return Estimates(recording, None, None)
    wall = estimate_wall(recording)
    mended = wall.applied(recording)
    valves = find_valve_times(mended, wall)
    found = valves.applied(mended)
    # what passes through a plane that is cut out of a flow is no contradiction
    return Estimates(found, wall, valves, None if recording.cut else flow_agreement(found, valves))
