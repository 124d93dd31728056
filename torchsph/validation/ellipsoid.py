"""A pulsating ellipsoid with one open end, or two: affine wall motion, and the potential flow it drives, for tests."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import eval_legendre

import geometry
from torchsph.simulator.scene import Fluid, Scene, Valve
from torchsph.simulator.schemes.presets import preset
from torchsph.simulator.schemes.scheme import Scheme
from torchsph.simulator.schemes.valve_models import Reservoir
from torchsph.simulator.schemes.wall_models import CompleteKernelWall
from torchsph.simulator.simulation import Simulation
from torchsph.simulator.simulator import Simulator

OPENING, LEAK = 1, 2
# so far (spacings) from walls and opening the core begins
_RIND = 2.0


@dataclass(frozen=True)
class PulsatingEllipsoid:
    """A spheroid around z, cut by a plane across its upper end, whose points move as (r x, r y, s z)(t) from t = 0.

    r = (1 - p)^k and s = (1 - p)^(1 - 2 k) with p = stroke (1 - cos(2 pi t / period)) / 2, so that the volume is
    (1 - p) of the first one in closed form. The plane is the opening (region 1); it is open all the time. With a leak
    the lower end is cut as well (region 2) and passes a fixed part of dV/dt.

    Attributes:
        radius: semi-axis across z at t = 0, m.
        height: semi-axis along z at t = 0, m.
        opening: polar angle of the opening's rim, degrees, on the sphere that the affine motion makes of the spheroid.
        stroke: part of the volume that is ejected.
        period: s.
        share: k, what the width takes of the volume's change.
        leak: part of dV/dt that goes through the lower end, or 0: it is not cut.
        leak_opening: polar angle of the lower end's rim, degrees, from below.
    """

    radius: float = 8e-3
    height: float = 10e-3
    opening: float = 35.0
    stroke: float = 0.4
    period: float = 0.2
    share: float = 0.4
    leak: float = 0.0
    leak_opening: float = 35.0

    @property
    def lower_plane(self) -> float:
        """Depth of the lower end below the centre in semi-axes."""
        return float(np.cos(np.radians(self.leak_opening))) if self.leak else 1.0

    @property
    def plane(self) -> float:
        """Height of the opening over the centre in semi-axes."""
        return float(np.cos(np.radians(self.opening)))

    def fraction(self, time: float) -> tuple[float, float]:
        """V(t) / V(0) and its rate, 1/s."""
        phase = 2 * np.pi * time / self.period
        return 1 - self.stroke * (1 - np.cos(phase)) / 2, -self.stroke * np.pi / self.period * np.sin(phase)

    def volume(self, time: float) -> float:
        """V, m^3."""
        part = self.lower_plane - self.lower_plane**3 / 3 + self.plane - self.plane**3 / 3
        return self.fraction(time)[0] * np.pi * self.radius**2 * self.height * part

    def volume_rate(self, time: float) -> float:
        """dV/dt, m^3/s."""
        value, rate = self.fraction(time)
        return self.volume(time) * rate / value

    def scales(self, time: float) -> tuple[float, float]:
        """Stretch across and along z since t = 0."""
        value = self.fraction(time)[0]
        return value**self.share, value ** (1 - 2 * self.share)

    def strain(self, time: float) -> np.ndarray:
        """Rates (3,) of the affine motion, 1/s: wall points move with strain * place."""
        value, rate = self.fraction(time)
        return rate / value * np.array([self.share, self.share, 1 - 2 * self.share])

    def motion(self, spacing: float, beats: int = 1, keys: int = 24) -> geometry.WallMotion:
        """The wall with vertices about ``spacing`` (m) apart, at ``keys`` key frames a beat, periodic."""
        lowest = np.pi - np.radians(self.leak_opening) if self.leak else np.pi
        steps = max(8, round((lowest - np.radians(self.opening)) * max(self.radius, self.height) / spacing))
        angle = np.linspace(lowest, np.radians(self.opening), steps + 1)
        across = max(2, round(self.radius * np.sin(angle[-1]) / spacing))
        below = max(2, round(self.radius * np.sin(lowest) / spacing)) if self.leak else 0
        disc = np.sin(angle[-1]) * (1 - np.arange(1, across + 1) / across)
        ring = np.concatenate([np.sin(lowest) * np.arange(below) / max(below, 1), np.sin(angle), disc])
        ring[[0, -1]] = 0.0
        level = np.concatenate([np.full(below, -self.lower_plane), np.cos(angle), np.full(across, self.plane)])
        profile = np.stack([self.radius * ring, self.height * level], 1)
        surface = geometry.revolved(profile, spacing, np.repeat([LEAK, 0, OPENING], [below, steps, across]))
        times = np.linspace(0, beats * self.period, beats * keys + 1)
        stretch = np.array([[*([self.scales(t)[0]] * 2), self.scales(t)[1]] for t in times])
        places = surface.vertices * stretch[:, None]
        rates = places * np.stack([self.strain(t) for t in times])[:, None]
        return geometry.WallMotion.through(
            times, places, surface.faces, surface.region, rates=rates, period=beats * self.period
        )

    def start(self, scheme: str | Scheme, across: int = 16, backend: str = "auto") -> Simulation:
        """Blood at rest at t = 0 in free-slip walls, ``across`` spacings wide; ``scheme`` or a preset of that name."""
        spacing = 2 * self.radius / across
        valves = tuple(Valve(region, ((-1.0, 1e9),)) for region in ((OPENING, LEAK) if self.leak else (OPENING,)))
        scene = Scene(spacing=spacing, fluid=Fluid(), walls=self.motion(spacing / 2), valves=valves)
        scheme = preset(scheme) if isinstance(scheme, str) else scheme
        return Simulator(scene, replace(scheme, wall=CompleteKernelWall(no_slip=False)), backend=backend).start(0.0)

    def core_errors(self, run: Simulation) -> tuple[float, float]:
        """Mean squares (m^2/s^2) of the particles' error and of the potential flow, 2 spacings inside the surface."""
        spacing, size = run.units.length, np.array(self.scales(run.time)) * (self.radius, self.height)
        place = (run.particles.position[run.particles.inside] * spacing).double().numpy()
        speed = (run.particles.velocity[run.particles.inside] * run.units.speed).double().numpy()
        depth = 1 - np.linalg.norm(place / size[[0, 0, 1]], axis=1)
        core = (depth * size.min() > _RIND * spacing) & (self.plane * size[1] - place[:, 2] > _RIND * spacing)
        exact = self.flow(run.time).velocity(place[core])
        return float(((speed[core] - exact) ** 2).sum(1).mean()), float((exact**2).sum(1).mean())

    def missing(self, run: Simulation) -> float:
        """Part of the cavity's volume that the particles fall short of; what stands in the opening counts in part.

        Raises:
            ValueError: the run has no ``Reservoir`` with a relaxation.
        """
        run.surroundings.at(run.time)
        rate = run.domain.valves.volume_deficit_rate(run.particles, run.surroundings.clock)
        valve = run.domain.scheme.valve
        if not isinstance(valve, Reservoir) or valve.relaxation is None:
            raise ValueError("what is missing is known to a Reservoir with a relaxation only")
        return float(rate) * valve.relaxation

    def flow(self, time: float, order: int = 40) -> PotentialFlow:
        """The potential flow at ``time`` (s): the wall's normal velocity, a plug through the opening."""
        across, along = self.scales(time)
        return PotentialFlow(
            self.radius * across,
            self.height * along,
            self.plane,
            self.strain(time),
            self.volume_rate(time),
            order,
            self.lower_plane,
            self.leak,
        )


@dataclass(frozen=True)
class PotentialFlow:
    """Axially symmetric potential flow in a cut spheroid by least squares over the harmonics regular at its centre.

    phi = sum_n c_n rho^n P_n(cos theta), whose normal derivative fits the boundary's in the mean square over its area
    (the Trefftz method, e.g. Kita & Kamiya 1995).

    Attributes:
        radius: present semi-axis across z, m.
        height: present semi-axis along z, m.
        plane: the cut's height in semi-axes.
        strain: (3,), 1/s.
        rate: dV/dt, m^3/s.
        order: highest n.
        lower_plane: depth of a cut across the lower end in semi-axes, 1 without.
        leak: part of ``rate`` that enters through it.
    """

    radius: float
    height: float
    plane: float
    strain: np.ndarray
    rate: float
    order: int
    lower_plane: float = 1.0
    leak: float = 0.0

    @cached_property
    def _scale(self) -> float:
        return max(self.radius, self.height)

    @property
    def plug(self) -> float:
        """Velocity along z in the opening, m/s: what leaves the volume and the plane's own motion."""
        area = np.pi * self.radius**2 * (1 - self.plane**2)
        return float(self.strain[2] * self.plane * self.height - (1 - self.leak) * self.rate / area)

    @property
    def lower_plug(self) -> float:
        """Velocity along z in the lower end, m/s."""
        area = np.pi * self.radius**2 * (1 - self.lower_plane**2)
        entering = self.leak * self.rate / area if self.leak else 0.0
        return float(-self.strain[2] * self.lower_plane * self.height + entering)

    def _boundary(self, count: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points (m, 2) of (r, z), outward normals (m, 2), normal velocities (m,) and area weights (m,)."""
        node, weight = np.polynomial.legendre.leggauss(count)
        first, last = np.arccos(self.plane), np.pi - np.arccos(self.lower_plane)
        angle = first + (last - first) * (node + 1) / 2
        wall = np.stack([self.radius * np.sin(angle), self.height * np.cos(angle)], 1)
        normal = np.stack([np.sin(angle) / self.radius, np.cos(angle) / self.height], 1)
        stretch = np.hypot(self.radius * np.cos(angle), self.height * np.sin(angle))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        points, normals, speeds = [wall], [normal], [(wall * self.strain[[0, 2]] * normal).sum(1)]
        areas = [weight * stretch * wall[:, 0] * (last - first) / 2]
        discs = [(self.plane, 1.0, self.plug), (-self.lower_plane, -1.0, -self.lower_plug)]
        for level, outwards, speed in discs if self.leak else discs[:1]:
            widest = self.radius * np.sqrt(1 - level**2)
            wide = widest * (node + 1) / 2
            points.append(np.stack([wide, np.full(count, level * self.height)], 1))
            normals.append(np.tile([0.0, outwards], (count, 1)))
            speeds.append(np.full(count, speed))
            areas.append(weight * wide * widest / 2)
        return np.concatenate(points), np.concatenate(normals), np.concatenate(speeds), np.concatenate(areas)

    @cached_property
    def _fit(self) -> tuple[np.ndarray, float]:
        """Coefficients (order,), and what is left of the normal velocity over its mean square."""
        points, normal, speed, weight = self._boundary()
        rows = (self._modes(points) * normal[:, :, None]).sum(1)
        root = np.sqrt(weight)
        found = np.linalg.lstsq(root[:, None] * rows, root * speed, rcond=1e-12)[0]
        return found, float(np.linalg.norm(root * (rows @ found - speed)) / np.linalg.norm(root * speed))

    @property
    def residual(self) -> float:
        """Root mean square of the normal velocity that the boundary misses, relative."""
        return self._fit[1]

    def _modes(self, points: np.ndarray) -> np.ndarray:
        """Gradients (m, 2, order) of the harmonics 1 ... order at (r, z) (m, 2)."""
        number = np.arange(1, self.order + 1)
        r, z = points.T / self._scale
        rho = np.maximum(np.hypot(r, z), 1e-12)
        cosine = np.clip(z / rho, -1, 1)
        value, before = (eval_legendre(n[None, :], cosine[:, None]) for n in (number, number - 1))
        # grad (rho^n P_n) has the z component n rho^(n-1) P_(n-1); the radial one follows from Euler's relation
        power = number * rho[:, None] ** (number - 1)
        along = power * before
        across = np.where(
            r[:, None] > 1e-9, (power * rho[:, None] * value - z[:, None] * along) / np.maximum(r, 1e-9)[:, None], 0.0
        )
        return np.stack([across, along], 1) / self._scale

    def velocity(self, points: np.ndarray) -> np.ndarray:
        """Velocity (m, 3), m/s, at points (m, 3), m."""
        wide = np.hypot(points[:, 0], points[:, 1])
        plane = self._modes(np.stack([wide, points[:, 2]], 1)) @ self._fit[0]
        direction = points[:, :2] / np.maximum(wide, 1e-12)[:, None]
        return np.concatenate([plane[:, :1] * direction, plane[:, 1:]], 1)
