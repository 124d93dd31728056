"""A running simulation: members on their way through time, and what is done to them from outside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from geometry import Grid
from geometry.arguments import checked
from torchsph.pairs.cell_search import nearest_image
from torchsph.pairs.moving_least_squares import Fetched

from .advancing import AdvancingRun
from .scene import Scene
from .schemes.scheme import Scheme
from .state.checks import check_count
from .state.particles import Particles
from .stepping.coefficients import Coefficients
from .stepping.pressure import Neighbourhood, divergence_free
from .transfer.checks import check_grid, check_mask, check_some, check_velocity, check_weight
from .transfer.fetching import fetch_on_grid
from .transfer.imposing import pulled
from .walls.displacement import WallDisplacement

MOST_PROJECTIONS = 1000


class Model(Protocol):
    """What runs come from (``Simulator``)."""

    @property
    def scene(self) -> Scene:
        """What is simulated."""

    @property
    def scheme(self) -> Scheme | None:
        """How it is stepped."""

    @property
    def backend(self) -> str:
        """Name of the pair backend."""

    @property
    def device(self) -> str:
        """Where particles live."""

    def resume(self, particles: Particles, time: float) -> Simulation:
        """Another run, from given particles on."""


class Simulation(AdvancingRun):
    """A run whose parameters may be changed, and whose velocities may be imposed, projected, pulled and fetched.

    Attributes:
        simulator: what the run comes from, where a ``Simulator`` has made it.
    """

    simulator: Model

    def change(self, **values: float | Sequence[float] | Tensor | None) -> None:
        """Change parameters from now on: one number for all members, or a row (members,) with one for each.

        Names are those of ``Parameters``; None switches a term off.

        Raises:
            ValueError: a value cannot be, or the scheme has no place for it.
        """
        scheme = self.domain.scheme
        if scheme.changeable is not None and not set(values) <= set(scheme.changeable):
            known = ", ".join(scheme.changeable)
            raise ValueError(f"of the incompressible scheme only {known} can change, got {list(values)}")
        if values.get("xsph") is not None and scheme.xsph is None:
            raise ValueError("parameter 'xsph' needs a scheme with XSPH, which says of what level and form it is")
        if "valve_strength" in values and not self.domain.valves.takes_strength:
            raise ValueError(
                "parameter 'valve_strength' needs pressure sources, or valves with a given flux or pressure"
            )
        if "smoothing_ratio" in values and self.domain.walls is not None and scheme.wall.complete:
            raise ValueError("the tables of a complete-kernel wall are made for the scheme's smoothing_ratio")
        self.parameters = self.parameters.changed(self.particles.velocity, self.members, **values)
        self.surroundings.valve_strength = self.parameters.valve_strength
        self._coefficients = Coefficients.of(self.parameters, self.units, self.domain.scene.fluid.density)
        self._stepper.use(self._coefficients)
        self._stepper.pair_search.radius = self._stepper.support.radius
        self._stepper.pair_search.forget()

    def displace_walls(self, amount: float | Tensor | None, shapes: Tensor | np.ndarray | None = None) -> None:
        """Move the walls along their outward normals, from now on, to first order.

        For walls that are a little off where the scene has them, and for gradients in their place
        (``Simulator.differentiable``). Good while an amount is small beside the particle spacing and the walls' radii
        of curvature. Openings keep their outlines, valves the fluxes that they are given, and the particles their
        places: displace before imposing.

        Args:
            amount: m, positive where the cavity grows: one number, or (K,) for as many shapes; None: back again.
            shapes: (K, V), how far each vertex of the walls goes per amount; None: all by the one amount.

        Raises:
            ValueError: the scene has no walls; amounts and shapes that do not go together, or are not finite.
        """
        if amount is None:
            self.surroundings.displacement = None
        else:
            walls = self.domain.scene.walls
            if walls is None:
                raise ValueError("the scene has no walls to displace")
            vertices = walls.vertices_at_keys.shape[1]
            self.surroundings.displacement = WallDisplacement.checked(amount, shapes, vertices)
        if self.surroundings.entered:
            self.surroundings.enter(self.time, self.time)

    @checked
    def impose(self, grid: Grid, velocity: Tensor, mask: Tensor, confidence: Tensor | None = None) -> None:
        """Replace the particles' velocities by those of a grid at the present time.

        Args:
            grid: the nodes, m.
            velocity: (D, *shape) for all members or (members, D, *shape), m/s.
            mask: (*shape) bool, where the velocity is known. Beyond it the walls' velocity continues the field.
            confidence: (*shape), not negative, how far each node is to be trusted; the particles carry it along, and it
                weighs them in XSPH and in fetching (Grønli 2017, sec. 5.2). None: all alike.

        Raises:
            TypeError: something else than tensors, or a mask that is not bool.
            ValueError: another dimension or shape than the run's and the grid's, no node in the mask, a velocity that
                is not finite there, a confidence that is negative, not finite or 0 everywhere.
        """
        check_grid(grid, self.domain.scene.dimension)
        check_mask(mask, grid)
        check_velocity("velocity", velocity, grid, mask, (1, self.members))
        if not bool(mask.any()):
            raise ValueError("mask holds no node: no velocity is known anywhere, so there is nothing to impose")
        if confidence is not None:
            check_weight("confidence", confidence, grid)
            check_some("confidence", confidence, "give what is to be trusted more than 0, or None for all alike", mask)
        self._renumbered(self.surroundings.imposed(self.particles, grid, velocity, mask, self.time))
        carried = None
        if confidence is not None:
            field = confidence.to(self.particles.velocity)[None]
            carried = grid.sample(field, self.particles.position * self.units.length)[0].clamp_min(0.0)
        self.particles = replace(self.particles, confidence=carried)
        self._imposed_at = self.time

    @property
    def can_project(self) -> bool:
        """Whether ``project`` knows what the scene's walls ask for."""
        return self.domain.walls is None or self.domain.scheme.wall.complete

    @checked
    def project(self, times: int = 1) -> Tensor:
        """Make the fluid's velocities free of divergence, as the walls and the flux of open valves ask for.

        Costs ``times`` pressure solves; meant for velocities that were imposed, in scenes whose fluid fills its walls
        or its periodic box. Returns (members,) what was taken from the velocities, RMS relative to the RMS of what is
        left: the blow that the fluid would have got from its pressure in the first step.
        """
        if not self.can_project:
            raise ValueError("projecting velocities needs complete-kernel walls; potential walls have no kernel share")
        times = check_count(times, "times must be at least one projection", MOST_PROJECTIONS)
        self.surroundings.enter(self.time, self.time)
        wall = self.surroundings.sample(self.particles)
        search = self._stepper.pair_search
        neighbourhood = Neighbourhood(self.particles, search, search.at(self.particles), self._stepper.support, wall)
        before = self.particles
        self.particles = before.changed(velocity=divergence_free(neighbourhood, times=times))
        mass = torch.where(before.fluid, before.mass, torch.zeros_like(before.mass)).double()
        taken, left = (
            before.per_member(mass * velocity.double().square().sum(1), "sum")
            for velocity in (before.velocity - self.particles.velocity, self.particles.velocity)
        )
        return (taken / left.clamp_min(torch.finfo(left.dtype).tiny)).sqrt()

    @checked
    def pull(self, grid: Grid, target: Tensor, gain: Tensor, weight: Tensor) -> None:
        """Pull the particles' velocities towards a measured grid.

        Args:
            grid: the nodes, m.
            target: (D, *shape), m/s.
            gain: (*shape), in [0, 1].
            weight: (*shape), not negative, confidence; 0 where nothing is known and the target may be anything, but not
                everywhere.

        Raises:
            TypeError: something else than tensors of floating-point numbers.
            ValueError: another dimension or shape than the run's and the grid's, or a value that cannot be.
        """
        check_grid(grid, self.domain.scene.dimension)
        check_weight("weight", weight, grid)
        check_some("weight", weight, "do not pull where there is no measurement")
        check_weight("gain", gain, grid, most=1.0)
        check_velocity("target", target, grid, weight > 0)
        p = self.particles
        target, gain, weight = (each.to(p.velocity) for each in (target, gain, weight))
        points = p.position * self.units.length
        moved = pulled(points, p.velocity * self.units.speed, grid, target, gain, weight) / self.units.speed
        self.particles = p.changed(velocity=torch.where(p.inside[:, None], moved, p.velocity))

    def follow(self) -> None:
        """Remember where every particle is now: ``travelled`` tells later how far the fluid has come."""
        self.particles = replace(self.particles, origin=self.particles.position.clone())

    @checked
    def travelled(self, grid: Grid, mask: Tensor) -> Fetched:
        """How far the fluid at the nodes where ``mask`` (*shape) has come since ``follow``; as ``fetch``, but m.

        Raises:
            RuntimeError: nobody has begun to follow the particles.
            TypeError: a mask that is not bool.
            ValueError: another dimension or shape than the run's and the grid's.
        """
        p = self.particles
        if p.origin is None:
            raise RuntimeError("nobody follows the particles: call follow() where their way is to begin")
        way = nearest_image(p.position - p.origin, self.domain.period) * (self.units.length / self.units.speed)
        return self._fetched(p.changed(velocity=way), grid, mask)

    @checked
    def fetch(self, grid: Grid, mask: Tensor) -> Fetched:
        """Velocities at the nodes where ``mask`` (*shape): value (members, D, *shape), covered (members, *shape).

        A node a little beyond the walls has the velocity of the fluid before them.

        Raises:
            TypeError: a mask that is not bool.
            ValueError: another dimension or shape than the run's and the grid's.
        """
        return self._fetched(self.particles, grid, mask)

    def _fetched(self, particles: Particles, grid: Grid, mask: Tensor) -> Fetched:
        """What particles of this moment carry in place of velocities, at the nodes of a mask."""
        check_grid(grid, self.domain.scene.dimension)
        check_mask(mask, grid)
        nearest = None
        if self.domain.walls is not None:
            if not self.surroundings.entered:
                self.surroundings.enter(self.time, self.time)
            nearest = self.surroundings.nearest_fluid
        return fetch_on_grid(particles, grid, mask, self.units, self._backend, self.domain.period, nearest)
