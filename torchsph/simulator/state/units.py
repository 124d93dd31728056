"""Internal units: lengths in particle spacings, velocities in the reference speed, densities relative to rho0."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Units:
    """Conversion between SI and internal units.

    float32 in SI metres loses the small differences that the pair sums live on (a ventricle is 0.03 m); in these units
    every quantity is of order one.

    Attributes:
        length: m per internal length (the particle spacing).
        speed: m/s per internal velocity.
    """

    length: float
    speed: float

    def __post_init__(self) -> None:
        if not self.length > 0 or not self.speed > 0:
            raise ValueError(f"units must be positive, got length {self.length} m and speed {self.speed} m/s")

    @property
    def time(self) -> float:
        """s per internal time."""
        return self.length / self.speed

    @property
    def acceleration(self) -> float:
        """m/s^2 per internal acceleration."""
        return self.speed**2 / self.length

    @property
    def kinematic_viscosity(self) -> float:
        """m^2/s per internal kinematic viscosity."""
        return self.length * self.speed
