"""The particles of a run every n steps, as one file that ParaView plays."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol

import numpy as np
from torch import Tensor

from geometry.arguments import between, checked
from geometry.formats import PolySeries

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..state.particles import Particles
    from ..state.units import Units


class Scheme(Protocol):
    """How a run is stepped."""

    @property
    def compressible(self) -> bool:
        """Whether pressure follows from density, instead of a projection."""


class Domain(Protocol):
    """Where a run takes place."""

    @property
    def scheme(self) -> Scheme:
        """How it is stepped."""


class Run(Protocol):
    """What is written of a run: any `Simulation` has it."""

    particles: Particles
    units: Units
    time: float
    observers: list[Callable[[Tensor, Tensor], None]]

    @property
    def domain(self) -> Domain:
        """Where it takes place."""


class ParticleSeries:
    """Writes one member's particles while the block lasts, its first and last state included.

    `with ParticleSeries("run.vtkhdf", run, every=10): run.advance(0.1)` gives a temporal file of VTKHDF's polygonal
    data with `velocity` (m/s), `volume` at rest density (m^3, in a plane m^2), `deviation` of the density, `kind` (see
    :class:`Particles`) and, where the scheme projects, `pressure` over density (m^2/s^2). The file appears whole
    when the block ends well; what it holds is kept in memory until then. Writing changes nothing of the run.
    """

    @checked(every=between(1, 2**31), member=between(0, 2**31))
    def __init__(self, path: str | Path, run: Run, *, every: int = 1, member: int = 0) -> None:
        """Begin with the present state.

        Args:
            path: of the file; its folder exists.
            run: a `Simulation`.
            every: steps of the member from one state to the next.
            member: whose particles.

        Raises:
            ValueError: every is below 1, or there is no such member.
            FileNotFoundError: there is no such folder.
        """
        if every < 1:
            raise ValueError(f"every must be at least 1 step, got {every!r}")
        if not 0 <= member < run.particles.members:
            raise ValueError(f"member must lie in 0 to {run.particles.members - 1}, got {member!r}")
        if not Path(path).parent.is_dir():
            raise FileNotFoundError(f"{path}: there is no directory {Path(path).parent}; make it first")
        self._run, self._every, self._member = run, every, member
        self._series, self._steps, self._latest = PolySeries(path), 0, -np.inf
        self._projects = not run.domain.scheme.compressible  # the same fields at every time, as the format asks

    def __enter__(self) -> ParticleSeries:
        self._write(self._run.time)
        self._run.observers.append(self._observe)
        return self

    def __exit__(self, kind: type | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        self._run.observers.remove(self._observe)
        if fault is None and self._run.time > self._latest:
            self._write(self._run.time)
        self._series.__exit__(kind, fault, trace)

    def _observe(self, time: Tensor, length: Tensor) -> None:
        if not float(length[self._member]) > 0:
            return
        self._steps += 1
        if self._steps % self._every == 0:
            self._write(float(time[self._member]))

    def _write(self, time: float) -> None:
        particles, units = self._run.particles, self._run.units
        mine = particles.member == self._member

        def of(values: Tensor, scale: float = 1.0) -> np.ndarray:
            kept = values[mine].detach().cpu().numpy()
            return kept * scale if scale != 1.0 else kept

        data = {
            "velocity": of(particles.velocity, units.speed),
            "volume": of(particles.mass, units.length**particles.dimension),
            "deviation": of(particles.deviation),
            "kind": of(particles.kind),
        }
        if self._projects:  # before the first projection there is no pressure: NaN
            unknown = particles.deviation * np.nan
            data["pressure"] = of(unknown if particles.pressure is None else particles.pressure, units.speed**2)
        self._series.append(time, of(particles.position, units.length), point_data=data)
        self._latest = time + 1e-12 * max(abs(time), 1.0)
