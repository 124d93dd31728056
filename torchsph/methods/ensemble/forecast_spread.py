"""A forecast ensemble before it meets observations: failed members replaced, model error added, the spread right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from geometry.grids.fields import fwhm_to_deviation
from torchsph.assimilation import replace_failed

from ..measurement.observation_operator import Measurement
from .analyses import Analyses
from .forecaster import Ensemble, Forecasts
from .model_error import flow_perturbations
from .options import EnsembleOptions


class ForecastSpread:
    """Keeps the members apart as far as the forecast may be wrong.

    Args:
        measurement: whose grid, mask and resolution are the state's.
        options: of the cycle.
        members: N.
        generator: of everything random; shared with the cycle.
        analyses: where events are noted, and members have their past.
    """

    def __init__(
        self,
        measurement: Measurement,
        options: EnsembleOptions,
        members: int,
        generator: torch.Generator,
        analyses: Analyses,
    ) -> None:
        self.measurement, self.options, self.members = measurement, options, members
        self.generator, self.analyses = generator, analyses
        self.reference_speed = measurement.prepared.reference_speed

    def perturbations(self, frame: int, amplitude: float, generator: torch.Generator | None = None) -> Tensor:
        """(N, D, *shape) flow-like perturbations of RMS ``amplitude``, m/s, over the mask of a frame."""
        grid, length = self.measurement.grid, self.options.length
        if length is None:
            length = max(fwhm_to_deviation(self.measurement.kernel), float(np.mean(grid.spacing)))
        mask = np.array(self.measurement.recording.mask[frame], bool)
        draw = self.generator if generator is None else generator
        cut = self.measurement.recording.cut
        return flow_perturbations(self.members, mask, grid.spacing, amplitude, length, draw, cut=cut).to(torch.float32)

    def prepared(self, forecasts: Forecasts, noise: Tensor | None, frame: int, factor: float) -> list[Ensemble]:
        """The forecasts as they meet the observations of ``frame``.

        Args:
            forecasts: of control and members.
            noise: (N, D, *shape), the model error's perturbations of RMS 1; None for no model error.
            frame: of the analysis.
            factor: on the anomalies (``SpreadMatch``).
        """
        states = forecasts.states
        if forecasts.control_failed:
            self.analyses.happened(frame, failed="control", donor="mean of the members")
        if bool(forecasts.failed.any()):
            states = self._replaced(states, forecasts.failed, frame)
        mask = torch.from_numpy(np.array(self.measurement.recording.mask[frame], bool))
        rms = max(float(states[-1].control[:, mask].square().mean().sqrt()), self.reference_speed)
        error = 0.0 if noise is None else self.options.model_error * rms * noise
        prepared = []
        for state in states:
            anomalies = state.members - state.members.mean(0) + error
            prepared.append(replace(state, members=state.control + factor * anomalies))
        return prepared

    def _replaced(self, states: Sequence[Ensemble], failed: Tensor, frame: int) -> list[Ensemble]:
        members = torch.stack([state.members for state in states], 1)
        if int((~failed).sum()) < 2:  # too few to draw from: a new ensemble around the control
            fresh = self.perturbations(frame, self.reference_speed)
            members = torch.stack([state.control + fresh for state in states], 1)
            self.analyses.members_are_new()
            self.analyses.happened(frame, failed=torch.nonzero(failed).flatten().tolist(), donor="control")
        else:
            repaired = replace_failed(members.flatten(1), failed, self.generator)
            members = repaired.ensemble.reshape(members.shape)
            for event in repaired.events:
                self.analyses.happened(frame, failed=event.member, donor=event.donor)
                self.analyses.member_replaced(event.member, event.donor)
        return [replace(state, members=members[:, k]) for k, state in enumerate(states)]
