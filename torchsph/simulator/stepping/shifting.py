"""Particle shifting: small displacements down the gradient of the concentration keep the particles even."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchsph.pairs.vectors import norm, per_particle

from ..schemes.scheme import Scheme
from ..state.particles import Particles
from .coefficients import Coefficients

# a floor on the speed (of the reference speed) keeps a resting fluid from freezing in disorder
_SPEED_FLOOR = 0.05
# a cap (spacings) keeps the shift below anything that the velocity would have to be corrected for
_LARGEST_SHIFT = 0.1


@dataclass(frozen=True)
class Shifting:
    """Displacement -A h |v| dt grad C that evens out the particles (Lind et al. 2012, speed-limited form).

    Attributes:
        strength: A, a number or (members,).
        smoothing_length: h, internal, a number or (members,).
        largest: whether |v| is the largest speed of the member (Sun et al. 2017, eq. 14), so that stagnation points are
            evened out as well, or each particle's own.
        surface: h |grad C| above which particles lie at a free surface and stay, or None: there the gradient points out
            of the fluid (0.74 on a plane surface for Wendland C2, 0.03 two spacings below).
    """

    strength: float | Tensor
    smoothing_length: float | Tensor
    largest: bool = False
    surface: float | None = None

    @classmethod
    def of(cls, scheme: Scheme, coefficients: Coefficients) -> Shifting | None:
        """The shifting of a scheme with the coefficients in use, or None where it is switched off."""
        if coefficients.shifting is None:
            return None
        largest = scheme.shifting_speed == "largest"
        return cls(coefficients.shifting, coefficients.smoothing_length, largest, scheme.shifting_surface)

    def displacement(self, particles: Particles, concentration_gradient: Tensor, step: Tensor) -> Tensor:
        """Displacements of a step.

        Args:
            particles: with the velocity that limits the shift.
            concentration_gradient: (N, D), internal, complete at walls.
            step: (members,), internal time.

        Returns:
            (N, D), internal.
        """
        member = particles.member
        speed = norm(particles.velocity).clamp_min(_SPEED_FLOOR)
        if self.largest:
            speed = particles.per_member(speed, "amax").index_select(0, member)
        amount = per_particle(self.strength * self.smoothing_length, member) * speed * per_particle(step, member)
        shift = -amount[:, None] * concentration_gradient
        if self.surface is not None:
            steepness = per_particle(self.smoothing_length, member) * norm(concentration_gradient)
            shift = shift * (steepness < self.surface)[:, None]
        length = norm(shift)
        return shift * (_LARGEST_SHIFT / length.clamp_min(_LARGEST_SHIFT))[:, None]
