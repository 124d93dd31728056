"""All observations of one cycle, whatever measurement and time they come from, beside what the members predict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

import geometry
from torchsph.assimilation import ErrorScale, Observations, concatenate

from .observation_operator import FrameObservations, Measurement
from .regions import flow_regions
from .unwrapping import nearest_branch


class Part(NamedTuple):
    """A measurement, one of its frames, and the number of the forecast's time at which it was taken."""

    measurement: Measurement
    seen: FrameObservations
    time: int


@dataclass(frozen=True)
class ObservationBatch:
    """Observations of a cycle, m numbers, part after part.

    Attributes:
        parts: where they come from.
        masks: (*shape) bool for each time, where forecasts are known.
        observations: all of them together.
        group: (m,) which learned error scale each belongs to.
        members: (N, m) what the members predict.
        regions: masks (m,) by name.
    """

    parts: Sequence[Part]
    masks: Sequence[Tensor]
    observations: Observations
    group: Tensor
    members: Tensor
    regions: dict[str, Tensor] = field(default_factory=dict)

    def predicted(self, fields: Tensor) -> Tensor:
        """(J, m) fields (J, D, *shape) where they are observed; 0 where nothing of them is."""
        return torch.nan_to_num(
            torch.cat([one.predict(fields, self.masks[time], seen) for one, seen, time in self.parts], 1)
        )


def error_groups(measurements: Sequence[Measurement]) -> list[int]:
    """The number of each measurement's first learned error scale, one scale per component; last, how many there are."""
    return np.cumsum([0] + [one.type.parts for one in measurements]).tolist()


def gathered(
    parts: Sequence[Part],
    members: Sequence[Tensor],
    masks: Sequence[Tensor],
    measurements: Sequence[Measurement],
    scale: ErrorScale,
) -> ObservationBatch | None:
    """The observations of a cycle with the errors that were learned; None where there are none.

    Args:
        parts: of the cycle.
        members: (N, D, *shape), m/s, forecast for each of its times.
        masks: (*shape) bool, where they are known.
        measurements: all of the run.
        scale: factors on the stated error variances.
    """
    parts = [part for part in parts if len(part.seen.position)]
    if not parts:
        return None
    first = error_groups(measurements)
    group = torch.cat(
        [
            torch.arange(seen.parts).repeat_interleave(len(seen.position)) + first[measurements.index(measurement)]
            for measurement, seen, _ in parts
        ]
    )
    observations = scale.apply(concatenate([part.seen.observations for part in parts]), group)
    predicted = torch.cat([one.predict(members[time], masks[time], seen) for one, seen, time in parts], 1)
    if any(part.seen.components.limit is not None for part in parts):
        observations = nearest_branch(observations, predicted, torch.cat([part.seen.limit for part in parts]))
    return ObservationBatch(parts, masks, observations, group, predicted)


def regions_of(
    batch: ObservationBatch, control: Tensor, surface: geometry.Surface, grid: geometry.Grid
) -> dict[str, Tensor]:
    """Masks (m,) of the observations by region, from the estimate (D, *shape), m/s, on the state's grid."""
    speed = control.norm(dim=0)[None]
    found = []
    for _, seen, _ in batch.parts:
        there = grid.sample(speed, seen.position)[0]
        masks = flow_regions(surface, seen.position, there, float(min(grid.spacing)))
        found.append({name: mask.repeat(seen.parts) for name, mask in masks.items()})
    return {name: torch.cat([masks[name] for masks in found]) for name in found[0]}
