"""One thing that is odd about a recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """What is odd, where, and what to do.

    Attributes:
        dataset: of the recording file, or an attribute.
        rule: what is odd, with its numbers.
        cure: what to do.
        severe: whether the recording is refused for it.
    """

    dataset: str
    rule: str
    cure: str
    severe: bool = False

    @property
    def rule_and_cure(self) -> str:
        """Both as one sentence."""
        return f"{self.rule}; {self.cure}"

    def __str__(self) -> str:
        return f"{self.dataset}: {self.rule_and_cure}"


def sampled(frames: int, most: int) -> Iterator[int]:
    """Up to `most` frame numbers spread over all of them, the first one included."""
    step = max(1, -(-frames // most))
    yield from range(0, frames, step)
