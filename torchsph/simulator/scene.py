"""What is simulated: fluid, walls, valves, forces.  A part that is None is neither computed nor stored."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import geometry
from geometry.arguments import checked
from geometry.recordings.opening_flux import MOST_REGIONS

# s: beyond every time of a recording
_FOREVER = 1e12
# m^3/s: a measured flux is never exact, however it is stated
_LEAST_SIGMA = 1e-12
# openings and closings of a valve in one stretch of time: more are a slip in its period
_MOST_BEATS = 100_000


@checked
@dataclass(frozen=True)
class Fluid:
    """A Newtonian fluid: density (kg/m^3) and dynamic viscosity (Pa s; 0 is inviscid)."""

    density: float = 1060.0
    viscosity: float = 0.004

    def __post_init__(self) -> None:
        if not 0 < self.density < math.inf:
            raise ValueError(f"Fluid.density must be positive and finite (kg/m^3), got {self.density}")
        if not 0 <= self.viscosity < math.inf:
            raise ValueError(f"Fluid.viscosity must be finite and not negative (Pa s), got {self.viscosity}")

    @property
    def kinematic_viscosity(self) -> float:
        """nu = mu / rho, m^2/s."""
        return self.viscosity / self.density


@checked
@dataclass(frozen=True)
class Valve:
    """An orifice of the wall that opens and closes.

    Attributes:
        region: label of its faces in the wall (1 mitral inlet, 2 aortic outlet, further ones allowed).
        intervals: rows (opening time, closing time), s.
        period: s, after which the intervals repeat; 0: they do not.
        span: (first, last) time, s, that the intervals speak of; with a period, times beyond are brought back by whole
            periods, as those of a wall's motion are. None: one period from the first opening on.
        pressure: Pa, a number or a function of time (s); flow through the open valve then follows from it, instead of
            the change of the cavity's volume (None). Only differences between valves that are open together matter.
        flux: m^3/s (m^2/s in a plane), inwards, a number, a function of time (s), or a table (times (s), fluxes) that
            is linear between its times and repeats with ``period``. The other open valves take what it leaves of the
            change of the cavity's volume. None: this one does, beside others by what each carries when a field is
            imposed.
        flux_sigma: m^3/s, standard deviation of ``flux``. Where no open valve is left to take the rest, uncertain
            fluxes are moved, each by its variance, until they sum to the change of the cavity's volume. 0: exact.
        leak: part of the opening's area that stays open while the valve is shut, from 0 to below 1: a soft closed
            valve. It passes what an imposed field has there, or shares by that area. None: shut is shut.
        stagnation: whether ``pressure`` is that of still fluid behind the valve, of which fluid that enters has spent
            rho v^2 / 2 (Bernoulli), or the static pressure in the opening itself. Fluid leaves against either alike.
    """

    region: int
    intervals: tuple[tuple[float, float], ...]
    period: float = 0.0
    span: tuple[float, float] | None = None
    pressure: float | Callable[[float], float] | None = None
    stagnation: bool = True
    flux: float | Callable[[float], float] | tuple[Sequence[float], Sequence[float]] | None = None
    flux_sigma: float = 0.0
    leak: float | None = None

    def __post_init__(self) -> None:
        if self.region != int(self.region) or not 1 <= self.region <= MOST_REGIONS:
            raise ValueError(
                f"Valve.region must be a whole number from 1 (0 labels the wall) to {MOST_REGIONS}, got {self.region}"
            )
        for opening, closing in self.intervals:
            if not closing > opening:
                raise ValueError(f"valve of region {self.region}: closes at {closing} s before it opens at {opening} s")
        if not 0 <= self.period < math.inf:
            raise ValueError(f"Valve.period must be finite and not negative (s), got {self.period}")
        if self.period and not all(math.isfinite(t) for interval in self.intervals for t in interval):
            raise ValueError(f"valve of region {self.region}: intervals that repeat must be finite: {self.intervals}")
        if self.span is not None and not self.span[1] - self.span[0] >= self.period * (1 - 1e-9):
            raise ValueError(f"Valve.span must cover the period of {self.period} s, got {self.span}")

        if self.flux is not None and self.pressure is not None:
            raise ValueError(f"valve of region {self.region}: give its flux or its pressure, not both")
        if isinstance(self.flux, tuple):
            self._check_table(self.flux)
        if not 0 <= self.flux_sigma < math.inf:
            given = f"got {self.flux_sigma}"
            raise ValueError(f"Valve.flux_sigma of region {self.region} must be finite, not negative (m^3/s), {given}")
        if self.leak is not None and not 0 <= self.leak < 1:
            raise ValueError(f"Valve.leak of region {self.region} must lie in [0, 1) or be None, got {self.leak}")

    def _check_table(self, table: tuple[Sequence[float], Sequence[float]]) -> None:
        """Raise ValueError where a table of fluxes has no times that increase, or a flux that is not finite."""
        if len(table) != 2 or len(table[0]) != len(table[1]) or not len(table[0]):
            raise ValueError(f"Valve.flux of region {self.region}: a table is (times, fluxes) of one length")
        rising = all(b > a for a, b in zip(table[0], table[0][1:], strict=False))
        if not rising or not all(math.isfinite(x) for row in table for x in row):
            raise ValueError(f"Valve.flux of region {self.region}: times must increase and fluxes be finite (s, m^3/s)")

    @checked
    def flux_at(self, time: float) -> float:
        """The given flux inwards (m^3/s; m^2/s in a plane) at ``time`` (s).

        Raises:
            ValueError: it is not given, not finite, or a table without a period does not reach to this time.
        """
        if self.flux is None:
            raise ValueError(f"the valve of region {self.region} has no given flux")
        if isinstance(self.flux, tuple):
            times, values = self.flux
            if self.period:
                value = float(np.interp(time, times, values, period=self.period))
            elif times[0] - 1e-9 <= time <= times[-1] + 1e-9:
                value = float(np.interp(time, times, values))
            else:
                known = f"from {times[0]:g} to {times[-1]:g} s"
                raise ValueError(f"Valve.flux of region {self.region} is known {known}, not at {time:g} s")
        else:
            value = float(self.flux(time) if callable(self.flux) else self.flux)
        if not math.isfinite(value):
            raise ValueError(f"Valve.flux of region {self.region} must be finite (m^3/s), got {value} at {time:g} s")
        return value

    @checked
    def pressure_at(self, time: float) -> float:
        """The given pressure (Pa) at ``time`` (s).

        Raises:
            ValueError: it is not finite, or none is given.
        """
        if self.pressure is None:
            raise ValueError(f"valve of region {self.region} has no given pressure")
        value = float(self.pressure(time) if callable(self.pressure) else self.pressure)
        if not math.isfinite(value):
            raise ValueError(f"Valve.pressure of region {self.region} must be finite (Pa), got {value} at {time:g} s")
        return value

    @checked
    def is_open(self, time: float) -> bool:
        """Whether the valve is open at ``time`` (s); closed at the closing instant itself."""
        times = [time]
        if self.period and self.intervals:
            first, last = self._covered
            if time > last:
                time -= math.ceil((time - last) / self.period) * self.period
            elif time < first:
                time += math.ceil((first - time) / self.period) * self.period
            # an interval may reach over the end of what is known
            times = [time] + [t for t in (time - self.period, time + self.period) if not first <= t <= last]
        return any(opening <= t < closing for opening, closing in self.intervals for t in times)

    @checked
    def passes(self, time: float) -> bool:
        """Whether anything may go through at ``time`` (s): the valve is open, or leaks."""
        return bool(self.leak) or self.is_open(time)

    @checked
    def open_part(self, time: float) -> float:
        """Part of the opening's area that is open at ``time`` (s)."""
        return 1.0 if self.is_open(time) else self.leak or 0.0

    def events(self, start: float, stop: float) -> list[float]:
        """Times in [start, stop], s, at which the valve may open or close."""
        times = [t for interval in self.intervals for t in interval]
        if not self.period or not times:
            return [t for t in times if start <= t <= stop]
        if (stop - start) / self.period > _MOST_BEATS:
            raise ValueError(
                f"valve of region {self.region}: its period of {self.period:g} s fits more than {_MOST_BEATS} times "
                f"into {start:g} to {stop:g} s; give all of them in seconds"
            )
        found: set[float] = set()
        for t in (*times, *self._covered):
            beats = range(math.ceil((start - t) / self.period), math.floor((stop - t) / self.period) + 1)
            found.update(t + beat * self.period for beat in beats)
        return sorted(found)

    @property
    def _covered(self) -> tuple[float, float]:
        """What the intervals speak of, s."""
        if self.span is not None:
            return self.span
        first = min(opening for opening, _ in self.intervals)
        return first, first + self.period


@checked
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
        cut: of a plane, whether it is cut out of a flow in space: its velocities keep the divergence that is imposed.
    """

    spacing: float
    fluid: Fluid = field(default_factory=Fluid)
    walls: geometry.WallMotion | None = None
    valves: tuple[Valve, ...] = ()
    gravity: tuple[float, ...] | Callable[[float], Sequence[float]] | None = None
    period: tuple[float | None, ...] | None = None
    reference_speed: float = 1.0
    dimension: int = 3
    cut: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.valves, tuple | list) or not all(isinstance(one, Valve) for one in self.valves):
            raise TypeError(f"Scene.valves must be a tuple of Valve, got {self.valves!r:.60}")
        for name in ("spacing", "reference_speed"):
            if not isinstance(getattr(self, name), int | float | np.number):
                raise TypeError(f"Scene.{name} must be one number, got {getattr(self, name)!r:.60}")
        if not 0 < self.spacing < math.inf:
            raise ValueError(f"Scene.spacing must be positive and finite (m), got {self.spacing}")
        if self.dimension not in (2, 3):
            raise ValueError(f"Scene.dimension must be 2 or 3, got {self.dimension}")
        if self.cut and self.dimension != 2:
            raise ValueError("Scene.cut is of planes: a flow in space has nothing that passes through it")
        if not 0 < self.reference_speed < math.inf:
            raise ValueError(f"Scene.reference_speed must be positive and finite (m/s), got {self.reference_speed}")
        exact = [valve.flux is not None and not valve.flux_sigma for valve in self.valves]
        if self.valves and all(exact):
            raise ValueError(
                "every valve has a given flux: leave the flux of at least one to what is left of dV/dt (flux=None)"
            )
        if self.valves and self.walls is None:
            raise ValueError("a scene with valves needs walls: the valves are orifices of the wall")
        for name in ("gravity", "period"):
            value = getattr(self, name)
            if value is not None and not callable(value) and len(value) != self.dimension:
                raise ValueError(f"Scene.{name} needs {self.dimension} entries, got {len(value)}")
        if self.gravity is not None and not callable(self.gravity) and not all(map(math.isfinite, self.gravity)):
            raise ValueError(f"Scene.gravity must be finite (m/s^2), got {self.gravity}")
        if not all(length is None or 0 < length < math.inf for length in self.period or ()):
            raise ValueError(f"Scene.period must be positive and finite (m), or None along an axis, got {self.period}")
        self._check_walls()

    def _check_walls(self) -> None:
        """Raise ValueError where walls have another dimension, or a valve no faces of them, or faces of another's."""
        if self.walls is None:
            return
        if self.walls.dimension != self.dimension:
            raise ValueError(f"Scene.dimension is {self.dimension}, but its walls have {self.walls.dimension}")
        regions, present = [valve.region for valve in self.valves], set(np.unique(self.walls.region).tolist())
        missing = sorted(set(regions) - present)
        if missing:
            raise ValueError(
                f"the valve of region {missing[0]} has no face in the walls, whose regions are {sorted(present)}; "
                "label the faces of its orifice, or leave the valve out"
            )
        if len(set(regions)) < len(regions):
            raise ValueError(f"two valves have the same region: {sorted(regions)}; give one of them all intervals")

    def gravity_at(self, time: float) -> tuple[float, ...]:
        """The body force per mass (D,), m/s^2, at ``time`` (s).

        Raises:
            ValueError: a function of time returns anything but D finite numbers.
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
    @checked
    def from_recording(
        cls,
        recording: geometry.Recording,
        spacing: float | None = None,
        *,
        estimates: geometry.Estimates | None = None,
    ) -> Scene:
        """The fluid, the moving walls and the valves of a recording: only what it has.

        ``spacing`` defaults to the smallest grid spacing. The reference speed is 1 m/s, typical of the heart, so that
        the same scene results from a noisy and from a clean recording. Walls that flicker are estimated, and valve
        times that the recording lacks or cannot mean (``geometry.estimated``), unless ``estimates`` holds them already.
        A flux that the recording has measured is that of its valve, with its error; ``/valve/leak`` is the valve's
        leak.
        """
        recording.wall_for("the simulator")
        recording = (geometry.estimated(recording) if estimates is None else estimates).recording
        intervals = recording.valve_intervals_or_derived()
        regions: dict[int, list[tuple[float, float]]] = {}
        span = (float(recording.time[0]), max(float(recording.time[-1]), float(recording.time[0]) + recording.period))
        for region, opening, closing in [] if intervals is None else intervals:
            rows = regions.setdefault(int(region), [])
            if recording.period:  # what was open at the first or last frame was so at the ends of what is known
                opening = float(opening) if math.isfinite(opening) else span[0]
                closing = float(closing) if math.isfinite(closing) else span[1]
            rows.append((float(opening), float(closing)))
        present = {int(region) for region in recording.wall_for("the simulator").region}
        rows_of_leak = [] if recording.valve_leak is None else recording.valve_leak.tolist()
        leak = {int(region): part for region, part in rows_of_leak if part > 0}
        measured = {flux.region: flux for flux in recording.fluxes}
        valves = tuple(
            Valve(
                region,
                tuple(sorted(regions.get(region, []))),
                recording.period,
                span,
                leak=leak.get(region),
                **_given_flux(measured.get(region), recording),
            )
            for region in sorted((set(regions) | set(leak)) & present)
        )
        return cls(
            spacing=float(min(recording.grid.spacing)) if spacing is None else spacing,
            fluid=Fluid(recording.rho, recording.mu),
            walls=geometry.WallMotion.from_recording(recording),
            valves=valves,
            dimension=recording.dimension,
            cut=recording.cut,
        )


def _given_flux(flux: geometry.OpeningFlux | None, recording: geometry.Recording) -> dict[str, Any]:
    """A measured flux as a valve's: beyond the frames of a recording that does not repeat it stays what it was last."""
    if flux is None:
        return {}
    times, values = [float(t) for t in recording.time], [float(value) for value in flux.value]
    if not recording.period:
        times, values = [-_FOREVER, *times, _FOREVER], [values[0], *values, values[-1]]
    return {"flux": (times, values), "flux_sigma": max(float(np.sqrt(np.mean(flux.deviation**2))), _LEAST_SIGMA)}
