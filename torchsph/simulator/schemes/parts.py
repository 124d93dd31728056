"""Parts that a scheme may have: velocity smoothing, a ramp of gamma, second chances for members that fail."""

from __future__ import annotations

from dataclasses import dataclass

from geometry.arguments import checked


@checked
@dataclass(frozen=True)
class XSPH:
    """XSPH (Grønli 2017, eq. 2.33): neighbours' velocities pull with strength ``epsilon``.

    ``level`` is "velocity" (eq. 2.34: the momentum itself is smoothed, as in the thesis; strongly dissipative) or
    "position" (Monaghan 1989: only the motion of the particles). ``form`` is "pairs" (the full sum) or "centroid"
    (sec. 5.2 there, the "poor man's XSPH": towards the mean velocities of the cells around, ``pairs.centroid``). Where
    the pair sums are compiled the full sum is the cheaper one: a tenth of a step in space, against two more steps.
    """

    epsilon: float = 0.2
    level: str = "velocity"
    form: str = "pairs"

    def __post_init__(self) -> None:
        if not 0 < self.epsilon <= 1:
            raise ValueError(f"XSPH epsilon must lie in (0, 1], got {self.epsilon}")
        if self.level not in ("velocity", "position"):
            raise ValueError(f"XSPH level must be 'velocity' or 'position', got '{self.level}'")
        if self.form not in ("pairs", "centroid"):
            raise ValueError(f"XSPH form must be 'pairs' or 'centroid', got '{self.form}'")


@checked
@dataclass(frozen=True)
class GammaRamp:
    """The exponent gamma of the Tait equation grows after a start or an imposition (Grønli 2017, sec. 5.2).

    So noise meets a soft fluid.

    Attributes:
        start: gamma at the imposition; it grows linearly in time to the scheme's gamma.
        duration: s, after which the scheme's gamma acts.
        keep: what stays while gamma grows. "prefactor": B = rho0 c^2 / gamma, so that the fluid starts softer, with
            the sound speed c sqrt(gamma(t) / gamma), and takes longer steps; "sound_speed": c, so that only the
            curvature of p(rho) changes (at small density deviations, next to nothing).
    """

    start: float = 1.0
    duration: float = 0.01
    keep: str = "prefactor"

    def __post_init__(self) -> None:
        if not self.start > 0 or not self.duration > 0:
            raise ValueError(f"GammaRamp needs positive start and duration (s), got {self.start}, {self.duration}")
        if self.keep not in ("prefactor", "sound_speed"):
            raise ValueError(f"GammaRamp.keep must be 'prefactor' or 'sound_speed', got '{self.keep}'")


@checked
@dataclass(frozen=True)
class Rollback:
    """A member that fails goes back to its last good state and tries again with steps half as long.

    The others wait meanwhile; a search of neighbours that its way back calls for may change them by round-off.

    Attributes:
        tries: how often from one state, each time with steps half as long again; then the member is frozen there.
        every: steps between the states that are kept; one is kept at the start of each imposed interval as well.
        density: range of rho / rho0; a member with a particle outside counts as failed, before it is not finite.
    """

    tries: int = 3
    every: int = 50
    density: tuple[float, float] = (0.5, 2.0)

    def __post_init__(self) -> None:
        if self.tries < 1 or self.every < 1:
            raise ValueError(f"Rollback needs at least one try and one step, got {self.tries}, {self.every}")
        if not 0 <= self.density[0] < 1 < self.density[1]:
            raise ValueError(f"Rollback.density must be a range around 1, got {self.density}")
