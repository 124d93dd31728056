"""What a run leaves behind: a field and its claimed deviation for each frame, and the events on the way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

import geometry
from torchsph.assimilation import Analysis

from ..measurement.wall_balance import WallBalance
from ..runtime.parallel import is_worker
from .divergence_cleaning import without_divergence
from .forecaster import Ensemble
from .lagged import Lagged, LaggedAnalyses


class Analyses:
    """The analyses so far, earlier ones as later data have moved them.

    Args:
        measured: the recording whose frames they belong to.
        lag: cycles whose data still move an analysis, or None.
        balance: of mass between the walls, which the fields keep; None: they keep their own.

    Attributes:
        fields: (D, *shape) for each frame, m/s, of the walls' balance of mass and without divergence.
        sigmas: (D, *shape) for each frame, m/s, what the filter claims.
        missing: nodes for each frame that the forecast did not cover.
        quality: (*shape) uint8 for each frame, codes of ``geometry.Quality``.
        events: dictionaries with their time, in order.
        shocks: what each forecast's start lost to the projection (``Forecasts.shock``).
    """

    fields: list[Tensor]
    sigmas: list[Tensor]
    missing: list[int]
    quality: list[Tensor]
    events: list[dict[str, Any]]
    shocks: list[float]

    def __init__(self, measured: geometry.Recording, lag: int | None, balance: WallBalance | None = None) -> None:
        self.measured, self.balance = measured, balance
        self.lagged = None if lag is None else LaggedAnalyses(lag)
        self.fields, self.sigmas, self.missing, self.quality, self.events, self.shocks = [], [], [], [], [], []

    def happened(self, frame: int, **what: Any) -> None:
        """Note an event at a frame."""
        self.events.append({"time": float(self.measured.time[frame]), **what})

    def add(self, ensemble: Ensemble, control: Tensor, sigma: Tensor, quality: Tensor, missing: int) -> None:
        """The next frame's analysis.

        Args:
            ensemble: that the next forecast starts from.
            control: (D, *shape), m/s, the estimate, 0 outside the mask.
            sigma: (D, *shape), m/s.
            quality: (*shape) uint8, codes of ``geometry.Quality``.
            missing: nodes that the forecast did not cover.
        """
        frame = len(self.fields)
        if self.lagged is not None:
            self.lagged.add(frame, control, ensemble.members - ensemble.control, sigma)
        self.fields.append(self._clean(control, frame))
        self.sigmas.append(sigma.to(torch.float32))
        self.quality.append(quality)
        self.missing.append(missing)

    def improved(self, analysis: Analysis, inside: Tensor, numbers: int) -> list[Lagged]:
        """Earlier analyses as a later one improves them (``LaggedAnalyses.improved``); none without a lag."""
        return [] if self.lagged is None else self.lagged.improved(analysis, inside, numbers)

    def take(self, earlier: Sequence[Lagged]) -> None:
        """Put improved analyses in the place of those they came from."""
        if self.lagged is None:
            return
        self.lagged.take(earlier)
        for improved in earlier:
            mask = torch.from_numpy(np.array(self.measured.mask[improved.frame], bool))
            self.fields[improved.frame] = self._clean(torch.where(mask, improved.control, 0.0), improved.frame)
            self.sigmas[improved.frame] = improved.sigma

    def member_replaced(self, member: int, donor: int) -> None:
        """A failed member goes on as another: so does its past."""
        if self.lagged is not None:
            self.lagged.replaced(member, donor)

    def members_are_new(self) -> None:
        """A new ensemble has no past."""
        if self.lagged is not None:
            self.lagged.clear()

    def recording(self, description: str) -> geometry.Recording:
        """The fields as a recording on the measurement's grid, mask and times."""
        return self.measured.with_velocity(
            np.stack([field.numpy() for field in self.fields]),
            sigma=np.stack([sigma.numpy() for sigma in self.sigmas]),
            uncovered=np.array(self.missing, np.int64),
            quality=np.stack([codes.numpy() for codes in self.quality]),
            description=description,
        )

    def state(self) -> dict[str, Any]:
        """What a checkpoint has to hold."""
        return {
            "fields": list(self.fields),
            "sigmas": list(self.sigmas),
            "missing": list(self.missing),
            "quality": list(self.quality),
            "events": list(self.events),
            "shocks": list(self.shocks),
            "lagged": [] if self.lagged is None else self.lagged.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        self.fields, self.sigmas, self.quality = (list(state[name]) for name in ("fields", "sigmas", "quality"))
        self.missing, self.events, self.shocks = (list(state[name]) for name in ("missing", "events", "shocks"))
        if self.lagged is not None:
            self.lagged.restore(state["lagged"])

    def _clean(self, control: Tensor, frame: int) -> Tensor:
        # what a worker has is given out by nobody; a cut plane's divergence is what passes through it
        if is_worker() or self.measured.cut:
            return control.to(torch.float32)
        mask = np.array(self.measured.mask[frame], bool)
        field = control.numpy() if self.balance is None else self.balance.nearest(control.numpy(), frame)
        found = without_divergence(field, mask, self.measured.grid.spacing)
        if not found.converged:
            self.happened(frame, divergence_left=found.left)
        return torch.from_numpy(found.velocity).to(torch.float32)
