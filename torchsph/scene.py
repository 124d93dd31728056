"""What is simulated: fluid, walls, valves, forces.  A part that is None is neither computed nor stored."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import geometry


@dataclass(frozen=True)
class Fluid:
    """A Newtonian fluid: density (kg/m^3) and dynamic viscosity (Pa s; 0 is inviscid)."""

    density: float = 1060.0
    viscosity: float = 0.004

    def __post_init__(self) -> None:
        if not self.density > 0:
            raise ValueError(f"Fluid.density must be positive (kg/m^3), got {self.density}")
        if not self.viscosity >= 0:
            raise ValueError(f"Fluid.viscosity must not be negative (Pa s), got {self.viscosity}")

    @property
    def kinematic_viscosity(self) -> float:
        """nu = mu / rho, m^2/s."""
        return self.viscosity / self.density


@dataclass(frozen=True)
class Valve:
    """An orifice of the wall that opens and closes.

    Attributes:
        region: label of its faces in the wall (1 mitral inlet, 2 aortic outlet, further ones allowed).
        intervals: rows (opening time, closing time), s.
    """

    region: int
    intervals: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        if self.region < 1:
            raise ValueError(f"Valve.region must be at least 1 (0 labels the wall), got {self.region}")
        for opening, closing in self.intervals:
            if not closing > opening:
                raise ValueError(f"valve of region {self.region}: closes at {closing} s before it opens at {opening} s")

    def is_open(self, time: float) -> bool:
        """Whether the valve is open at ``time`` (s); closed at the closing instant itself."""
        return any(opening <= time < closing for opening, closing in self.intervals)

    def events(self) -> tuple[float, ...]:
        """All opening and closing times, s."""
        return tuple(t for interval in self.intervals for t in interval)


@dataclass(frozen=True)
class Scene:
    """A scene of one flow, in SI units.

    Attributes:
        spacing: particle spacing, m.
        fluid: density and viscosity.
        walls: closed moving surface around the fluid, or None (no wall).
        valves: orifices of the wall; () where the wall has none.
        gravity: acceleration (D,), m/s^2, or None; or a function of time (s) that returns it, for a body force that
            changes (a pulsating pressure gradient, an accelerated frame).
        period: lengths (D,) of a periodic box that starts at the origin, m; None entries are not periodic.
        reference_speed: largest speed that is expected, m/s; it sets the internal units and the default sound speed.
        dimension: 2 or 3.
    """

    spacing: float
    fluid: Fluid = field(default_factory=Fluid)
    walls: geometry.WallMotion | None = None
    valves: tuple[Valve, ...] = ()
    gravity: tuple[float, ...] | Callable[[float], Sequence[float]] | None = None
    period: tuple[float | None, ...] | None = None
    reference_speed: float = 1.0
    dimension: int = 3

    def __post_init__(self) -> None:
        if not self.spacing > 0:
            raise ValueError(f"Scene.spacing must be positive (m), got {self.spacing}")
        if self.dimension not in (2, 3):
            raise ValueError(f"Scene.dimension must be 2 or 3, got {self.dimension}")
        if not self.reference_speed > 0:
            raise ValueError(f"Scene.reference_speed must be positive (m/s), got {self.reference_speed}")
        if self.valves and self.walls is None:
            raise ValueError("a scene with valves needs walls: the valves are orifices of the wall")
        for name in ("gravity", "period"):
            value = getattr(self, name)
            if value is not None and not callable(value) and len(value) != self.dimension:
                raise ValueError(f"Scene.{name} needs {self.dimension} entries, got {len(value)}")

    def gravity_at(self, time: float) -> tuple[float, ...]:
        """The body force per mass (D,), m/s^2, at ``time`` (s).

        Raises ValueError where a function of time returns anything but D finite numbers.
        """
        if not callable(self.gravity):
            return (0.0,) * self.dimension if self.gravity is None else tuple(self.gravity)
        value = tuple(float(part) for part in self.gravity(time))
        if len(value) != self.dimension or not all(math.isfinite(part) for part in value):
            raise ValueError(
                f"Scene.gravity must return {self.dimension} finite accelerations (m/s^2), got {value} at {time:g} s"
            )
        return value

    @classmethod
    def from_recording(cls, recording: geometry.Recording, spacing: float | None = None) -> Scene:
        """The fluid, the moving walls and the valves of a recording: only what it has.

        ``spacing`` defaults to the smallest grid spacing. The reference speed is 1 m/s, typical of the heart, so that
        the same scene results from a noisy and from a clean recording.
        """
        intervals = recording.valve_intervals_or_derived()
        regions: dict[int, list[tuple[float, float]]] = {}
        for region, opening, closing in ([] if intervals is None else intervals):
            regions.setdefault(int(region), []).append((float(opening), float(closing)))
        present = {int(region) for region in recording.wall.region}
        valves = tuple(Valve(r, tuple(sorted(rows))) for r, rows in sorted(regions.items()) if r in present)
        return cls(
            spacing=float(min(recording.grid.spacing)) if spacing is None else spacing,
            fluid=Fluid(recording.rho, recording.mu),
            walls=geometry.WallMotion.from_recording(recording),
            valves=valves,
            dimension=recording.dimension,
        )
