"""Later observations applied to earlier analyses: the fixed-lag ensemble smoother of the cycle."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsph.assimilation import Analysis


@dataclass(frozen=True)
class Lagged:
    """An earlier analysis.

    Attributes:
        frame: its number.
        control: (D, *shape), m/s, the estimate.
        anomalies: (N, D, *shape), m/s, of the members.
        sigma: (D, *shape), m/s, the claimed deviation.
    """

    frame: int
    control: Tensor
    anomalies: Tensor
    sigma: Tensor


class LaggedAnalyses:
    """The last ``lag`` analyses, moved by each later one.

    A filter's map of the members improves the states that those members came from (``Analysis.carried_back``; the
    smoother of whole ensembles is ``FixedLagSmoother``). Here the estimate is no mean of members: what the map moves
    the mean by is added to the estimate, what it takes from the anomalies' deviation is taken from the claim. It is as
    good as the sampled correlation between members and their past; ``EnsembleOptions.lag`` says what that is worth.
    """

    def __init__(self, lag: int) -> None:
        self.kept: deque[Lagged] = deque(maxlen=lag)

    def add(self, frame: int, control: Tensor, anomalies: Tensor, sigma: Tensor) -> None:
        """Keep an analysis, with the anomalies (N, D, *shape), m/s, of the ensemble that goes on from it."""
        self.kept.append(Lagged(frame, control, anomalies - anomalies.mean(0), sigma))

    def improved(self, analysis: Analysis, inside: Tensor, numbers: int) -> list[Lagged]:
        """All that are kept as ``analysis`` improves them; ``take`` makes them the ones that are kept.

        Args:
            analysis: of a later frame, with its transform.
            inside: (q,) nodes of the analysis. Nodes that have left the blood since stay as they are.
            numbers: of its state that stand for them, D q; what follows them are parameters, which earlier states do
                not hold.
        """
        size = analysis.ensemble.shape[1]
        return [_improved(one, analysis, inside, numbers, size) for one in self.kept]

    def take(self, improved: Sequence[Lagged]) -> None:
        """Make improved analyses the ones that are kept."""
        self.kept = deque(improved, self.kept.maxlen)

    def replaced(self, member: int, donor: int) -> None:
        """A failed member goes on as another: so does its past."""
        for one in self.kept:
            one.anomalies[member] = one.anomalies[donor]

    def clear(self) -> None:
        """After a new ensemble, whose members have no past."""
        self.kept.clear()

    def state(self) -> list[dict[str, Any]]:
        """What a checkpoint has to hold."""
        return [dict(vars(one)) for one in self.kept]

    def restore(self, state: list[dict[str, Any]]) -> None:
        """Go on from what ``state`` gave."""
        self.kept = deque((Lagged(**one) for one in state), self.kept.maxlen)


def _improved(earlier: Lagged, analysis: Analysis, inside: Tensor, numbers: int, size: int) -> Lagged:
    before = earlier.anomalies.flatten(2)[:, :, inside]
    count, parts = before.shape[:2]
    joint = torch.cat([before.flatten(1), before.new_zeros((count, size - numbers))], 1)
    moved = analysis.carried_back(joint)[:, :numbers]
    mean = moved.mean(0)
    after = (moved - mean).reshape(before.shape)
    shrunk = after.std(0) / before.std(0).clamp_min(torch.finfo(before.dtype).tiny)
    control, anomalies, sigma = (part.clone() for part in (earlier.control, earlier.anomalies, earlier.sigma))
    control.flatten(1)[:, inside] += mean.reshape(parts, -1)
    anomalies.flatten(2)[:, :, inside] = after
    sigma.flatten(1)[:, inside] *= shrunk.clamp(max=1.0)
    return replace(earlier, control=control, anomalies=anomalies, sigma=sigma)
