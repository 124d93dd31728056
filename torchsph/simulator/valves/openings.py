"""Open orifices as particles see them: plane, area, rim and the channel behind it, at the present time."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from geometry import OrificePlane, orifices
from geometry.motion.orifices import rim_distance
from torchsph.pairs.vectors import square_length

from ..scene import Scene, Valve
from ..state.clock import Clock
from ..state.units import Units

# half the width (spacings) over which what stands over an opening is blended in
_RIM = 0.5
# points across the radius of an opening in which its flux is read
_QUADRATURE = 24
# opening planes kept in memory, and the part of its area and of a spacing by which an opening may differ from its plane
_KEPT_PLANES = 64
_AREA_CHANGE, _PLACE_CHANGE = 0.01, 0.1


class OpeningPlane:
    """An opening in internal units on the device."""

    def __init__(
        self,
        plane: OrificePlane,
        velocity: np.ndarray,
        length: float,
        dtype: torch.dtype,
        device: str,
    ) -> None:
        def tensor(value: np.ndarray) -> Tensor:
            return torch.as_tensor(np.ascontiguousarray(value), dtype=dtype, device=device)

        plane = OrificePlane(
            plane.centroid / length,
            plane.normal,
            plane.area / length ** len(plane.basis),
            plane.basis,
            plane.rim / length,
            plane.edges,
        )
        self.centre, self.normal, self.basis = tensor(plane.centroid), tensor(plane.normal), tensor(plane.basis)
        self.area = float(plane.area)
        self.velocity = tensor(velocity)
        self._outline, self._edges = tensor(plane.outline), torch.from_numpy(plane.edges).to(device)
        self.radius = float(np.linalg.norm(plane.outline, axis=1).max())
        self._quadrature: Tensor | None = None
        self._clear = float(self.inset(self.centre[None]).clamp_min(0.0))  # nothing of the rim is nearer to the middle

    def height(self, position: Tensor) -> Tensor:
        """Outward distance from the plane, (n,)."""
        return (position - self.centre) @ self.normal

    def inset(self, position: Tensor) -> Tensor:
        """In-plane distance from the rim, (n,), positive over the opening."""
        return rim_distance((position - self.centre) @ self.basis.T, self._outline, self._edges)

    def cover(self, position: Tensor) -> Tensor:
        """Part of points (n, D) over the opening, (n,): blended in over a spacing at the rim."""
        aside = square_length(position - self.centre) - self.height(position).square()
        part = (aside < self._clear**2).to(position.dtype)
        low, high = max(self._clear - _RIM, 0.0), self.radius + _RIM
        rim = torch.nonzero((aside > low * low) & (aside < high * high)).squeeze(1)
        return part.index_copy(0, rim, (self.inset(position[rim]) / (2.0 * _RIM) + 0.5).clamp(0.0, 1.0))

    def behind(self, position: Tensor) -> Tensor:
        """(n,) bool: points (n, D) less than half a spacing before the opening, or in the channel behind it."""
        height = self.height(position)
        aside = (position - self.centre - height[:, None] * self.normal).norm(dim=1)
        return (height > -0.5) & (aside < self.radius + 1.0)

    def quadrature(self) -> Tensor:
        """Points evenly over the opening, (n, D), much closer than particles: their mean is the opening's."""
        if self._quadrature is None:
            step = self.radius / _QUADRATURE
            axis = torch.arange(-_QUADRATURE, _QUADRATURE, dtype=self.centre.dtype, device=self.centre.device) + 0.5
            flat = step * torch.cartesian_prod(*[axis] * self.basis.shape[0]).reshape(-1, self.basis.shape[0])
            place = self.centre + flat @ self.basis
            self._quadrature = place[self.inset(place) > 0]
        return self._quadrature

    def lattice(self, length: float) -> Tensor:
        """Unit lattice in the channel of the given length behind the opening, (n, D)."""
        reach = int(np.ceil(self.radius)) + 1
        axis = torch.arange(-reach, reach, dtype=self.centre.dtype, device=self.centre.device) + 0.5
        flat = torch.cartesian_prod(*[axis] * self.basis.shape[0]).reshape(-1, self.basis.shape[0])
        place = self.centre + flat @ self.basis
        place = place[self.inset(place) > 0]
        layers = torch.arange(int(length), dtype=place.dtype, device=place.device) + 0.5
        return (place[:, None, :] + layers[None, :, None] * self.normal).reshape(-1, self.centre.shape[0])


class Openings:
    """All openings of a scene's valves; a region may consist of several.

    Attributes:
        all: the orifices.
        valve_of: of each opening, the number of its valve.
        valves: those of the scene.
        given: numbers of the openings at a given pressure.
    """

    def __init__(self, scene: Scene, units: Units, device: str, dtype: torch.dtype) -> None:
        if scene.walls is None:
            raise ValueError("a scene with valves needs walls: the valves are orifices of the wall")
        self.motion, self.units, self._device, self._dtype = scene.walls, units, device, dtype
        self.valves: tuple[Valve, ...] = scene.valves
        labels = {valve.region: number for number, valve in enumerate(scene.valves)}
        self.all = [orifice for orifice in orifices(self.motion) if orifice.label in labels]
        self.valve_of = [labels[orifice.label] for orifice in self.all]
        self.given = [n for n, valve in enumerate(self.valve_of) if self.valves[valve].pressure is not None]
        # m^3/s (m^2/s in a plane) of one internal unit of volume per time
        self.flux_unit = units.length**self.motion.dimension / units.time
        self._pace = self._resting_time()
        self._planes: dict[tuple[int, int], OpeningPlane] = {}

    def _resting_time(self) -> float | None:
        """Time (s) in which no opening's area, or place, changes by more than this module allows; None: they rest."""
        if not self.motion.moves:
            return None
        fastest = 0.0
        for opening in self.all:
            planes = [opening.at(float(t)) for t in self.motion.time]
            for before, after, span in zip(planes, planes[1:], np.diff(self.motion.time), strict=False):
                grown = abs(after.area / before.area - 1.0) / _AREA_CHANGE
                gone = float(np.linalg.norm(after.centroid - before.centroid)) / (_PLACE_CHANGE * self.units.length)
                fastest = max(fastest, max(grown, gone) / span)
        return 1.0 / fastest if fastest > 0.0 else None

    def place_number(self, times: Tensor) -> Tensor:
        """Which of its places one after another every opening is in at times (s): the same number, the same planes."""
        return torch.zeros_like(times) if self._pace is None else torch.round(times / self._pace)

    def plane(self, number: int, time: float) -> OpeningPlane:
        """Opening ``number`` at ``time`` (s), to within the little that it may change unseen."""
        if self._pace is not None:
            time = round(time / self._pace) * self._pace
        if not self.motion.period:
            time = min(max(time, float(self.motion.time[0])), float(self.motion.time[-1]))
        label = (number, 0 if self._pace is None else int(round(time / self._pace)))
        if label not in self._planes:
            if len(self._planes) > _KEPT_PLANES:
                self._planes.clear()
            opening = self.all[number]
            self._planes[label] = OpeningPlane(
                opening.at(time),
                opening.velocity(time) / self.units.speed,
                self.units.length,
                self._dtype,
                self._device,
            )
        return self._planes[label]

    def active(self, clock: Clock) -> list[tuple[int, OpeningPlane]]:
        """(number, plane now) of the openings of open valves, for members that see the same planes."""
        return self.active_at(clock.first, clock)

    def active_at(self, time: float, clock: Clock) -> list[tuple[int, OpeningPlane]]:
        """(number, plane at ``time``, s) of the openings of valves that are open in the clock's interval."""
        return [(n, self.plane(n, time)) for n, orifice in enumerate(self.all) if orifice.label in clock.open_regions]

    def shut(self, clock: Clock) -> list[int]:
        """Numbers of the openings of valves that are shut."""
        return [n for n, orifice in enumerate(self.all) if orifice.label not in clock.open_regions]

    def valve(self, number: int) -> Valve:
        """The valve of an opening."""
        return self.valves[self.valve_of[number]]
