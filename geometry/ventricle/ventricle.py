"""The ventricle of Grønli 2017, sec. 3.4: a truncated prolate spheroid, elliptical inlet, circular outlet.

The base is the plane z = 0 and stays there, the apex lies on the negative z axis, and the wall moves
affinely: (x, y) grow with `radial(t)`, z with `axial(t)`. With v = V(t) / V(end diastole), axial = v^k and
radial = v^((1 - k) / 2), so that radial^2 axial = v, and volume and rate are exact in closed form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from geometry.arguments import checked
from geometry.grids.grid import Grid
from geometry.recordings.recording import Recording, Wall
from geometry.surfaces.surface import Surface

from .mesh import ventricle_surface


@checked
@dataclass(frozen=True)
class Beat:
    """The volume over one beat, as a fraction of the end-diastolic one, and when the valves are open.

    All times in s from end diastole; `ejection` is (start, end), `early` and `late` filling (E and A wave)
    likewise and may overlap. Flow starts and ends smoothly: each phase moves the volume as x - sin(2 pi x) /
    (2 pi).
    """

    period: float = 0.45
    stroke_fraction: float = 0.42
    ejection: tuple[float, float] = (0.03, 0.21)
    early: tuple[float, float] = (0.25, 0.37)
    late: tuple[float, float] = (0.33, 0.44)
    late_share: float = 0.35

    def __post_init__(self) -> None:
        if not 0 < self.stroke_fraction < 1 or not 0 <= self.late_share <= 1:
            raise ValueError("Beat: stroke_fraction must lie in (0, 1) and late_share in [0, 1]")
        for name in ("ejection", "early", "late"):
            start, end = getattr(self, name)
            if not 0 <= start < end <= self.period:
                raise ValueError(f"Beat: {name} must be (start, end) within the period, not {(start, end)}")
        if self.ejection[1] > min(self.early[0], self.late[0]):
            raise ValueError("Beat: filling must start after ejection has ended")

    @checked
    def volume(self, t: float) -> float:
        """V(t) / V(0), periodic."""
        return 1 + self._sum(t, lambda x: x - np.sin(2 * np.pi * x) / (2 * np.pi))[0]

    @checked
    def rate(self, t: float) -> float:
        """d/dt of `volume`, 1/s."""
        return self._sum(t, lambda x: 1 - np.cos(2 * np.pi * x))[1]

    @property
    def filling(self) -> tuple[float, float]:
        """When the inlet is open (s)."""
        return min(self.early[0], self.late[0]), max(self.early[1], self.late[1])

    def _sum(self, t: float, shape: Callable[[float], float]) -> tuple[float, float]:
        t, s, a = t % self.period, self.stroke_fraction, self.late_share
        value = rate = 0.0
        for share, (start, end) in ((-s, self.ejection), (s * (1 - a), self.early), (s * a, self.late)):
            x = min(max((t - start) / (end - start), 0.0), 1.0)
            value += share * shape(x)
            rate += share * shape(x) / (end - start)
        return value, rate


@checked
@dataclass(frozen=True)
class Ventricle:
    """The shape at end diastole (m) and its beat. Regions: 0 wall, 1 mitral inlet, 2 aortic outlet.

    Args:
        length: m, from base to apex.
        semi_major: m, of the spheroid, along z.
        semi_minor: m, across.
        mitral_centre: (x, y), m, in the base plane.
        mitral_semi_axes: m, along x and y.
        aortic_centre: (x, y), m, in the base plane.
        aortic_radius: m.
        axial_share: the k of the module's formula.
        beat: the volume over time, and when the valves are open.

    Raises:
        ValueError: orifices that leave the base or meet.
    """

    length: float = 0.030
    semi_major: float = 0.022
    semi_minor: float = 0.0090
    mitral_centre: tuple[float, float] = (-0.0041, 0.0)
    mitral_semi_axes: tuple[float, float] = (0.0034, 0.0050)
    aortic_centre: tuple[float, float] = (0.0040, 0.0)
    aortic_radius: float = 0.0036
    axial_share: float = 0.35
    beat: Beat = field(default_factory=Beat)

    def __post_init__(self) -> None:
        if not 0 < self.semi_major <= self.length < 2 * self.semi_major or not self.semi_minor > 0:
            raise ValueError("Ventricle: needs semi_minor > 0 and semi_major <= length < 2 semi_major (m)")
        mitral, aortic = self.rims(128)
        for name, rim in (("mitral", mitral), ("aortic", aortic)):
            if np.linalg.norm(rim, axis=1).max() >= self.base_radius:
                raise ValueError(
                    f"Ventricle: the {name} orifice reaches beyond the base of radius {self.base_radius:g} m"
                )
        away = aortic[:, None] - mitral[None]
        if np.linalg.norm(away, axis=-1).min() < 0.02 * self.base_radius or self._overlap(aortic):
            raise ValueError("Ventricle: the mitral and the aortic orifice meet; move them apart")

    @property
    def offset(self) -> float:
        """How far the spheroid's centre lies below the base (m)."""
        return self.length - self.semi_major

    @property
    def base_radius(self) -> float:
        """Radius of the base at end diastole (m)."""
        return self.semi_minor * float(np.sqrt(1 - (self.offset / self.semi_major) ** 2))

    @property
    def end_diastolic_volume(self) -> float:
        """V(0), m^3: the integral of pi r(z)^2 over the length."""
        a, c = self.semi_major, self.offset
        return np.pi * self.semi_minor**2 * (self.length - (a**3 + c**3) / (3 * a**2))

    @checked
    def volume(self, t: float) -> float:
        """Exact enclosed volume at time `t` (s), m^3."""
        return self.end_diastolic_volume * self.beat.volume(t)

    @checked
    def volume_rate(self, t: float) -> float:
        """Exact dV/dt at time `t`, m^3/s."""
        return self.end_diastolic_volume * self.beat.rate(t)

    def scales(self, t: float) -> np.ndarray:
        """Growth of x, y, z since end diastole, `(3,)`."""
        v, k = self.beat.volume(t), self.axial_share
        return np.array([v ** ((1 - k) / 2), v ** ((1 - k) / 2), v**k])

    def scale_rates(self, t: float) -> np.ndarray:
        """d/dt of `scales`, `(3,)`, 1/s."""
        k = self.axial_share
        return self.scales(t) * np.array([(1 - k) / 2, (1 - k) / 2, k]) * self.beat.rate(t) / self.beat.volume(t)

    @checked
    def wall_velocity(self, points: np.ndarray, t: float) -> np.ndarray:
        """The affine wall motion's velocity (m/s) at points `(n, 3)` of the wall at time `t`."""
        return points * (self.scale_rates(t) / self.scales(t))

    @checked
    def contains(self, points: np.ndarray, t: float) -> np.ndarray:
        """Whether points `(n, 3)`, m, lie inside at time `t`, bool `(n,)`; exact."""
        x, y, z = (np.asarray(points) / self.scales(t)).T
        radial = (x * x + y * y) / self.semi_minor**2
        return (z < 0) & (radial + ((z + self.offset) / self.semi_major) ** 2 < 1)

    @checked
    def rims(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Points on the mitral and the aortic rim at end diastole, `(count, 2)` each, m."""
        angle = 2 * np.pi * np.arange(count) / count
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        mitral = np.asarray(self.mitral_centre) + circle * np.asarray(self.mitral_semi_axes)
        return mitral, np.asarray(self.aortic_centre) + circle * self.aortic_radius

    @checked
    def surface(self, spacing: float, t: float = 0.0) -> Surface:
        """The triangulated surface at time `t`, vertices about `spacing` (m) apart at end diastole."""
        reference = ventricle_surface(self, spacing)
        return reference.moved(reference.vertices * self.scales(t))

    @checked
    def wall(self, time: np.ndarray, spacing: float) -> Wall:
        """The moving wall at times `(T,)`, s, with the exact velocity of its vertices."""
        reference = ventricle_surface(self, spacing)
        vertices = np.stack([reference.vertices * self.scales(t) for t in time])
        velocity = np.stack([reference.vertices * self.scale_rates(t) for t in time])
        return Wall(vertices, reference.faces, reference.region, velocity)

    @checked
    def recording(
        self,
        time: Sequence[float] | np.ndarray,
        *,
        grid_spacing: float = 1e-3,
        wall_spacing: float = 1e-3,
        velocity: Callable[[np.ndarray, float], np.ndarray] | None = None,
        rho: float = 1060.0,
        mu: float = 0.004,
        periodic: bool = False,
    ) -> Recording:
        """A recording of this ventricle at `time` (T,), s: walls, valves, mask, exact volume and fluxes.

        `velocity(points (n, 3), t) -> (n, 3)` m/s fills the grid inside; None leaves it at zero.
        """
        time = np.asarray(time, np.float64)
        radius, depth = self.base_radius if self.offset <= 0 else self.semi_minor, self.length
        largest = np.max([self.scales(t) for t in time], axis=0)
        lower = -np.array([radius, radius, depth]) * largest
        grid = Grid.covering(tuple(lower), (-lower[0], -lower[1], 0.0), grid_spacing)
        nodes = grid.nodes().numpy()
        mask = np.stack([self.contains(nodes, t).reshape(grid.shape) for t in time])
        field = np.zeros((len(time), 3, *grid.shape), np.float32)
        if velocity is not None:
            for frame, t in enumerate(time):
                values = np.where(mask[frame].reshape(-1, 1), velocity(nodes, t), 0)
                field[frame] = values.T.reshape(3, *grid.shape)
        return Recording(
            time=time,
            grid=grid,
            velocity=field,
            mask=mask,
            wall=self.wall(time, wall_spacing),
            rho=rho,
            mu=mu,
            period=self.beat.period if periodic else 0.0,
            description="parametric ventricle: truncated prolate spheroid, affine motion, fixed base z = 0",
            valve_intervals=np.array([(1, *self.beat.filling), (2, *self.beat.ejection)]),
            valve_open=np.stack([self._open(time, self.beat.filling), self._open(time, self.beat.ejection)], axis=1),
            volume=np.array([self.volume(t) for t in time]),
            flux_mitral=np.array([max(self.volume_rate(t), 0.0) for t in time]),
            flux_aortic=np.array([min(self.volume_rate(t), 0.0) for t in time]),
        )

    def _open(self, time: np.ndarray, interval: tuple[float, float]) -> np.ndarray:
        phase = time % self.beat.period
        return (phase >= interval[0]) & (phase < interval[1])

    def _overlap(self, aortic: np.ndarray) -> bool:
        place = (aortic - np.asarray(self.mitral_centre)) / np.asarray(self.mitral_semi_axes)
        apart = np.asarray(self.mitral_centre) - np.asarray(self.aortic_centre)
        return bool((np.linalg.norm(place, axis=1) < 1).any() or np.linalg.norm(apart) < self.aortic_radius)
