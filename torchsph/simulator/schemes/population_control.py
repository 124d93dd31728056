"""When particles that crowd are merged and holes are seeded again: the options of population control."""

from __future__ import annotations

from dataclasses import dataclass

from geometry.arguments import checked


@checked
@dataclass(frozen=True)
class PopulationControl:
    """When particles are merged and seeded.

    Attributes:
        every: steps between one look and the next.
        closest: particles nearer to each other than this (spacings) are merged, None: none are.
        heaviest: but not to more than this mass, in those of a cubic spacing of fluid.
        missing: an empty cell is seeded where at least so much of a particle is missing from the sum of all kernels at
            its centre, None: none are. Disorder alone takes up to a half.
    """

    every: int = 20
    closest: float | None = 0.4
    heaviest: float = 2.5
    missing: float | None = 0.75

    def __post_init__(self) -> None:
        if self.every < 1:
            raise ValueError(f"PopulationControl.every must be at least 1 step, got {self.every}")
        if self.closest is not None and not 0 < self.closest < 1:
            raise ValueError(f"PopulationControl.closest must lie in (0, 1) spacings or be None, got {self.closest}")
        if not self.heaviest > 0:
            raise ValueError(f"PopulationControl.heaviest must be positive, got {self.heaviest}")
        if self.missing is not None and not self.missing > 0:
            raise ValueError(f"PopulationControl.missing must be positive or None, got {self.missing}")
