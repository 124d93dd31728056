"""One measure over a recording and frame by frame, and the sums that it is made from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Score:
    """One measure: over the whole recording, and of each frame (`None` where it is not defined)."""

    value: float | None
    per_frame: list[float | None]


Scores = dict[str, Score]


def square_sums(field: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Sum over the mask and the components of a field (T, C, *shape), frame by frame, in float64: (T,)."""
    return np.array([np.sum(f[:, m].astype(np.float64) ** 2) for f, m in zip(field, mask, strict=True)])


def rms_score(sums: np.ndarray, counts: np.ndarray, scale: float | None) -> Score:
    """Root mean squares from sums (T,) and counts (T,) of the frames, over a scale."""

    def score(total: float, count: float) -> float | None:
        root = root_mean(total, count)
        return None if root is None or not scale else root / scale

    return Score(score(sums.sum(), counts.sum()), [score(s, n) for s, n in zip(sums, counts, strict=True)])


def root_mean(total: float, count: float) -> float | None:
    """Root of a total over a count, None over nothing."""
    mean = ratio(total, count)
    return None if mean is None else float(np.sqrt(mean))


def ratio(total: float, count: float) -> float | None:
    """A total over a count, None over nothing."""
    return float(total) / float(count) if count > 0 else None
