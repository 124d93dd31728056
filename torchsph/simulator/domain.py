"""The world around the particles: walls, valves, forces and periodic sides of a scene, in internal units."""

from __future__ import annotations

import torch
from torch import Tensor

from geometry import WallMotion
from torchsph.pairs.smoothing_kernels import kernel

from .scene import Scene
from .schemes.scheme import Scheme
from .state.energy import energy_unit
from .state.particles import Particles
from .state.units import Units
from .valves.model import ValveModel, ValveSetting
from .valves.registry import valve_model
from .walls.displacement import WallDisplacement
from .walls.fields import WallFields

# particles that fill less of what encloses them have a free surface
_LEAST_FILLING = 0.9


class Domain:
    """A scene with a scheme, made ready for particles; shared by all runs, which change nothing of it but caches.

    Attributes:
        support_radius: of the smoothing kernel, internal.
        period: (D,), internal, inf where an axis is not periodic; None: none is.
        walls: fields of the walls, or None without walls.
        valves: model of the valves; it knows how to do nothing.
        energy_unit: J (in a plane J/m) per internal energy.
    """

    def __init__(self, scene: Scene, scheme: Scheme, units: Units, device: str, dtype: torch.dtype) -> None:
        self.scene, self.scheme, self.units = scene, scheme, units
        self.device, self.dtype = device, dtype
        smoothing = kernel(scheme.kernel)
        self.energy_unit = energy_unit(units, scene.fluid.density, scene.dimension)
        self.support_radius = smoothing.support * scheme.smoothing_ratio
        self.period = self._period()
        self._steady_gravity: Tensor | None = None
        if scene.gravity is not None and not callable(scene.gravity):
            self._steady_gravity = self._acceleration([scene.gravity])
        self.walls: WallFields | None = None
        self.valves = ValveModel()
        if scene.walls is not None:
            self._check_periodic_walls(scene.walls)
            self.walls = WallFields(
                scene.walls,
                units.length,
                units.speed,
                smoothing,
                scheme.smoothing_ratio,
                scheme.wall.complete,
                device,
                dtype,
                sliding=scheme.wall.sliding,
            )
            if scheme.valve is not None and scene.valves:
                self.valves = valve_model(scheme.valve, self._valve_setting(self.walls))

    def _valve_setting(self, walls: WallFields) -> ValveSetting:
        return ValveSetting(
            self.scene,
            self.units,
            self.support_radius,
            self.scheme.compressible,
            walls.key_times.wrapped,
            self.period,
            self.device,
            self.dtype,
        )

    def _period(self) -> Tensor | None:
        if self.scene.period is None:
            return None
        lengths = [float("inf") if p is None else p / self.units.length for p in self.scene.period]
        return torch.tensor(lengths, dtype=self.dtype, device=self.device)

    def _check_periodic_walls(self, motion: WallMotion) -> None:
        """Walls of a periodic scene must reach past both ends, because what a particle sees is looked up inside.

        Raises:
            ValueError: they end within a kernel of the periodic box.
        """
        reach = (self.support_radius + 1.0) * self.units.length
        for axis, length in enumerate(self.scene.period or ()):
            if length is None:
                continue
            ends = motion.vertices_at_keys[..., axis]
            if ends.min() > -reach or ends.max() < length + reach:
                raise ValueError(
                    f"axis {axis} is periodic over {length:g} m, but the walls span only {ends.min():g} to "
                    f"{ends.max():g} m there; continue them unchanged at least {reach:g} m past both ends"
                )

    def fluid_volume(self, time: float) -> float:
        """Volume (area in a plane) that the walls enclose in one period, m^D, at ``time`` (s).

        Raises:
            ValueError: the scene has no walls.
        """
        motion = self.scene.walls
        if motion is None:
            raise ValueError("a scene without walls encloses no volume")
        volume, vertices = motion.volume(time), motion.vertices(time)
        for axis, length in enumerate(self.scene.period or ()):
            if length is not None:
                volume *= length / (vertices[:, axis].max() - vertices[:, axis].min())
        return volume

    def check_known(self, time: float) -> None:
        """Refuse a time (s) at which nobody knows where the wall is.

        Raises:
            ValueError: it lies off the key frames of a motion without a period.
        """
        if self.scene.walls is not None:
            self.scene.walls.locate(time)

    @torch.no_grad()  # an account, not a part of the flow
    def filling(self, particles: Particles, time: float) -> Tensor:
        """Volume of the particles inside over that of the walls, or of the periodic box, (members,) float64.

        0 where nothing encloses them.
        """
        inside = particles.per_member((particles.mass * particles.inside).double(), "sum")
        if self.walls is not None:
            return inside * self.units.length**particles.dimension / self.fluid_volume(time)
        if self.period is not None:
            return inside / self.period.double().prod()
        return torch.zeros_like(inside)

    def check_filled(self, particles: Particles, time: float, refusal: str) -> None:
        """Refuse fluid with a free surface.

        Args:
            particles: the fluid.
            time: s.
            refusal: what to say, with ``{filling}`` for the part of what encloses it that the emptiest member fills.

        Raises:
            ValueError: the particles of a member do not fill their walls, or their box.
        """
        filling = float(self.filling(particles, time).min()) if particles.count else 0.0
        if filling < _LEAST_FILLING:
            raise ValueError(refusal.format(filling=f"{100 * filling:.0f} %"))

    def breaks(self, start: float, stop: float) -> list[float]:
        """The times (s) in (start, stop] at which members meet: key frames, valve events, and ``stop``."""
        times = {stop}
        if self.walls is not None:
            times.update(self.walls.key_times.within(start, stop))
        if self.scheme.valve is not None:
            times.update(t for valve in self.scene.valves for t in valve.events(start, stop))
        tolerance = 1e-9 * max(1.0, abs(stop))
        inner = sorted(t for t in times if start + tolerance < t < stop - tolerance)
        return [*inner, stop] if stop > start else []

    def open_regions(self, time: float) -> tuple[int, ...]:
        """Regions of the valves that are open, or leak, at ``time`` (s)."""
        if self.scheme.valve is None:
            return ()
        return tuple(valve.region for valve in self.scene.valves if valve.passes(time))

    def prepare_until(self, start: float, stop: float) -> None:
        """Make the wall fields of a stretch of time (s) beforehand, so that the steps find them."""
        ends = self.breaks(start, stop)
        for early, late in zip([start, *ends], ends, strict=False):
            self.wall_keys(0.5 * (early + late), self.open_regions(0.5 * (early + late)))

    def wall_keys(
        self, time: float, open_regions: tuple[int, ...], displacement: WallDisplacement | None = None
    ) -> tuple[tuple[float, float], tuple[Tensor, Tensor]]:
        """Times (s) of the wall fields before and after ``time`` (s), and the fields, with some regions open.

        Args:
            time: s.
            open_regions: regions of the walls that are no wall.
            displacement: of the walls; None: they are where the scene has them.

        Raises:
            ValueError: the scene has no walls.
        """
        if self.walls is None:
            raise ValueError("a scene without walls has no wall fields")
        early, late, start, stop = self.walls.key_times.bracket(time)
        if displacement is None:
            return (start, stop), (self.walls.key(early, open_regions), self.walls.key(late, open_regions))
        displaced = self.walls.displaced
        first, second = (displaced(number, open_regions, displacement) for number in (early, late))
        return (start, stop), (first, second)

    def gravity(self, particles: Particles, times: Tensor) -> Tensor | None:
        """Gravity at the particles, (N, D), internal, or None; ``times`` (members,), s, of their members."""
        if self._steady_gravity is not None:
            return self._steady_gravity.expand_as(particles.position)
        if self.scene.gravity is None:
            return None
        return self._acceleration([self.scene.gravity_at(t) for t in times.tolist()]).index_select(0, particles.member)

    def _acceleration(self, rows: list[tuple[float, ...]]) -> Tensor:
        """Rows (n, D), m/s^2, as internal accelerations."""
        return torch.tensor(rows, dtype=self.dtype, device=self.device) / self.units.acceleration

    def wrapped(self, position: Tensor) -> Tensor:
        """Points (n, D), internal, brought back into the periodic box."""
        if self.period is None:
            return position
        finite = torch.isfinite(self.period)
        length = torch.where(finite, self.period, torch.ones_like(self.period))
        return torch.where(finite, torch.remainder(position, length), position)
