"""The simulators that go with a measurement: of its walls and valves, as fine as each method needs them."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import geometry
from geometry.arguments import checked
from torchsph.simulator.scene import Scene
from torchsph.simulator.schemes.presets import preset as scheme_preset
from torchsph.simulator.simulator import Simulator
from torchsph.simulator.state.checks import SPACING

from .measurement.prepared import PreparedMeasurement

# particle spacing in grid spacings of the single runs and of the ensemble's members; its control run takes half of it
ANALYSIS_SPACING = 2.0
CONTROL_SHARE = 0.5

# Between frames that correct it, coarser particles resolve less in time as well: in a human ventricle with 3 and 6 mm,
# steps of up to 0.7 spacings per m/s leave the ensemble's error as it is (.410, .409 with 0.7 ms) at 0.64 times the
# cost. At 1 mm they are the preset's own.
LONG_STEPS: dict[str, Any] = {"max_step": None, "longest_step": 0.7}


@checked(spacing=SPACING)
def make_model(
    recording: geometry.Recording,
    *,
    preset: str = "default",
    spacing: float | None = None,
    device: str = "cpu",
    estimates: geometry.Estimates | None = None,
) -> Simulator:
    """A simulator of the recording's walls and valves.

    Args:
        recording: whose walls, valves and fluid they are.
        preset: name of the scheme.
        spacing: of the particles, m; None: the grid's.
        device: where particles live.
        estimates: what ``geometry.estimated`` found of the recording, where that is known already.
    """
    scene = Scene.from_recording(recording, spacing, estimates=estimates)
    scheme = scheme_preset(preset, **LONG_STEPS) if preset == "default" else scheme_preset(preset)
    return Simulator(scene, scheme, device=device)


def analysis_spacing(prepared: PreparedMeasurement, asked: float | None) -> float:
    """Of the particles of single runs and of the ensemble's members, m."""
    return ANALYSIS_SPACING * min(prepared.recording.grid.spacing) if asked is None else asked


class Models:
    """The simulators of a measurement, each made when it is first asked for."""

    def __init__(
        self,
        prepared: PreparedMeasurement,
        preset: str,
        spacing: float | None,
        device: str,
        control_spacing: float | None = None,
    ) -> None:
        self.prepared, self.preset, self.device = prepared, preset, device
        self.spacing = analysis_spacing(prepared, spacing)
        self.control_spacing = CONTROL_SHARE * self.spacing if control_spacing is None else control_spacing

    def anew(self) -> Models:
        """The same, none of them made yet."""
        return Models(self.prepared, self.preset, self.spacing, self.device, self.control_spacing)

    @cached_property
    def coarse(self) -> Simulator:
        """Of single runs and of the ensemble's members."""
        return self._at(self.spacing)

    @cached_property
    def fine(self) -> Simulator:
        """Of the ensemble's control."""
        return self._at(self.control_spacing)

    def _at(self, spacing: float) -> Simulator:
        found = self.prepared.splines.estimates
        return make_model(
            self.prepared.recording, preset=self.preset, spacing=spacing, device=self.device, estimates=found
        )
