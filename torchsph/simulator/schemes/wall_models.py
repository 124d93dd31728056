"""How particles are kept inside walls: the options of the wall models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

from geometry.arguments import checked


class WallModel(Protocol):
    """What the engine asks of the options of any wall model; lengths in particle spacings."""

    @property
    def complete(self) -> bool:
        """Whether the pair sums are completed by the part of the kernel behind the wall, which is then looked up."""

    @property
    def hard(self) -> bool:
        """Whether particles are kept ``gap`` inside the wall outright; a soft wall is meant to be entered a little."""

    @property
    def gap(self) -> float:
        """Distance at which a hard wall stops particles."""

    @property
    def sliding(self) -> bool:
        """Whether what the walls sweep is integrated over their surface, for walls that slide past others."""

    @property
    def no_slip(self) -> bool:
        """Whether the wall brakes the fluid that slides along it."""

    @property
    def needs_compressible(self) -> bool:
        """Whether the wall acts through the speed of sound, which an incompressible scheme does not have."""


@checked
@dataclass(frozen=True)
class PotentialWall:
    """Potential U(s) = stiffness c^2 s^2 / 2 with s = 1 - d / reach for d < reach (Grønli 2017, eqs. 3.1 and 3.2).

    Attributes:
        stiffness: wall potential at d = 0 in units of c^2 / 2.
        reach: distance at which the potential starts, in particle spacings.
        relaxation: time constant tau of the no-slip retardation at the wall, in reach / c; None: free slip. The factor
            per step is xi = 1 - exp(-dt / tau * s), applied to the tangential velocity relative to the wall.
    """

    stiffness: float = 0.2
    reach: float = 1.0
    relaxation: float | None = 1.0
    complete: ClassVar[bool] = False
    hard: ClassVar[bool] = False
    gap: ClassVar[float] = 0.0
    sliding: ClassVar[bool] = False
    needs_compressible: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not self.stiffness > 0 or not self.reach > 0:
            raise ValueError(f"PotentialWall needs positive stiffness and reach, got {self.stiffness}, {self.reach}")
        if self.relaxation is not None and not self.relaxation > 0:
            raise ValueError(f"PotentialWall.relaxation must be positive or None, got {self.relaxation}")

    @property
    def no_slip(self) -> bool:
        """Whether the retardation acts."""
        return self.relaxation is not None


@checked
@dataclass(frozen=True)
class CompleteKernelWall:
    """Wall by the analytic kernel integrals behind it (Ferrand et al. 2013): no wall particles, one look-up each.

    Attributes:
        no_slip: laminar friction with the wall (True) or free slip.
        gap: particles are kept this far inside the wall, in particle spacings.
        sliding: for walls that slide past others at an edge, as the lid of a cavity does. What they sweep is then
            integrated over the surface; otherwise the nearest wall's velocity stands for all that a kernel sees, and
            a lid would seem to push the side walls (3 % of density in the corners, and noise from there).
    """

    no_slip: bool = True
    gap: float = 0.05
    sliding: bool = False
    complete: ClassVar[bool] = True
    hard: ClassVar[bool] = True
    needs_compressible: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not 0 <= self.gap < 0.5:
            raise ValueError(f"CompleteKernelWall.gap must lie in [0, 0.5), got {self.gap}")
