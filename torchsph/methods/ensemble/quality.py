"""Quality codes of an analysis: for each node of the state what became of the observations there."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import geometry
from geometry import Quality
from torchsph.assimilation import Reason

from ..measurement.observation_batch import Part
from ..measurement.observation_operator import FrameObservations, Measurement

_CODES = {
    Reason.USED: Quality.USED,
    Reason.GROSS_ERROR: Quality.OUTLIER,
    Reason.OUT_OF_REACH: Quality.OUT_OF_REACH,
    Reason.NOT_PREDICTED: Quality.FAILED,
    Reason.AMBIGUOUS: Quality.AMBIGUOUS,
}
# of several observations at a node the first of these is told
_RANK = (Quality.USED, Quality.AMBIGUOUS, Quality.OUTLIER, Quality.OUT_OF_REACH, Quality.FAILED, Quality.NO_DATA)


def first_codes(measurement: Measurement, mask: Tensor) -> Tensor:
    """(*shape) uint8 of the frame that the ensemble begins with: what its spline was made of."""
    seen = measurement.see(0)
    return _codes([(measurement, seen)], seen.observations.codes(), mask, measurement.grid)


def analysed_codes(parts: Sequence[Part], reason: Tensor, mask: Tensor, covered: Tensor, grid: geometry.Grid) -> Tensor:
    """(*shape) uint8 of an analysis.

    Args:
        parts: measurements and their frames, in the order of the observations.
        reason: (m,) ``Reason`` codes, as the filter gave them.
        mask: (*shape) bool.
        covered: (*shape) bool, where the forecast has values.
        grid: of the state.
    """
    codes = _codes([(measurement, seen) for measurement, seen, _ in parts], reason, mask, grid)
    return torch.where(mask & ~covered, int(Quality.FAILED), codes).to(torch.uint8)


def _codes(
    parts: Sequence[tuple[Measurement, FrameObservations]], reason: Tensor, mask: Tensor, grid: geometry.Grid
) -> Tensor:
    table = torch.full((len(Reason),), len(_RANK) - 1, dtype=torch.int64)
    for why, code in _CODES.items():
        table[why] = _RANK.index(code)
    best, first = torch.full((grid.size,), len(_RANK) - 1, dtype=torch.int64), 0
    for measurement, seen in parts:
        count = seen.parts * len(seen.node)
        rank = table[reason[first : first + count].long()].reshape(seen.parts, -1)
        first += count
        if len(seen.node):
            best = torch.minimum(best, _on_state(measurement, seen, rank.amin(0), grid))
    codes = torch.tensor([int(code) for code in _RANK], dtype=torch.uint8)[best].reshape(grid.shape)
    return torch.where(mask, codes, int(Quality.OUTSIDE)).to(torch.uint8)


def _on_state(measurement: Measurement, seen: FrameObservations, rank: Tensor, grid: geometry.Grid) -> Tensor:
    """(nodes,) ranks of places (q,) at the nodes of the state, each from the measurement's nearest node."""
    own = measurement.recording.grid
    every = torch.full((own.size,), len(_RANK) - 1, dtype=torch.int64)
    every[seen.node] = rank
    if measurement.same_grid:
        return every
    origin, spacing = (torch.tensor(part, dtype=torch.float64) for part in (own.origin, own.spacing))
    place = ((grid.nodes().double() - origin) / spacing).round().long()  # (n, D), x first
    sizes = torch.tensor(own.shape[::-1])
    near = ((place >= 0) & (place < sizes)).all(1)
    flat = torch.zeros(len(place), dtype=torch.int64)
    for axis in reversed(range(grid.dimension)):
        flat = flat * sizes[axis] + place[:, axis].clamp(0, int(sizes[axis]) - 1)
    return torch.where(near, every[flat], len(_RANK) - 1)
