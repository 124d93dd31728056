"""The penalised B-spline smoother: the fit of one velocity field, or of several at the same points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch

from regularize.arguments import checked
from regularize.basis.knots import Knots
from regularize.errors import InvalidInput
from regularize.options import BY_DATA, LOW_NOISE, RANGES, SAMPLES_OF_LOW_NOISE, SAMPLES_PER_KNOT, SplineOptions
from regularize.rows.operators import System
from regularize.rows.walls import WallRows
from regularize.solvers.direct import solve_direct
from regularize.solvers.implicit import solve_with_gradient
from regularize.solvers.interface import Limits, Neighbour
from regularize.solvers.memory import band_bytes, device_memory
from regularize.solvers.registry import AUTO, SOLVERS
from regularize.statistics.likelihood import Choice
from regularize.statistics.robust import robust_weight

from .field import SplineField
from .knot_grid import knots_for
from .problem import Problem
from .row_blocks import build_system
from .samples import FitData
from .search import choose


@checked(**RANGES)
@dataclass(frozen=True)
class Smoother(SplineOptions):
    """The spline fit with its options; see :class:`regularize.options.SplineOptions`."""

    def fit(
        self,
        points: torch.Tensor,
        velocity: torch.Tensor,
        weight: torch.Tensor | None = None,
        wall: WallRows | None = None,
        *,
        divergence_points: torch.Tensor | None = None,
        box: tuple[Sequence[float], Sequence[float]] | None = None,
        beam: torch.Tensor | None = None,
        uncertainty: bool = False,
        neighbour: SplineField | None = None,
        choice: Choice | None = None,
    ) -> SplineField:
        """Fit one set of samples.

        Args:
            points: (n, D), m; (n, D + 1) with the time in s last, then walls, divergence points and the field's
                arguments carry it too.
            velocity: (n, D), m/s; may be NaN where the weight is 0.
            weight: (n,), confidences in [0, 1]; samples of weight 0 are ignored.
            wall: rows on walls and valves.
            divergence_points: (m, D), m, where the divergence is penalised (and the field counts as supported);
                None: over every knot cell that holds samples or wall.
            box: (lower, upper), m, corners of the knot grid; None: around all points. Give the same one for all
                frames of a recording.
            beam: (n, D) or (D,), unit vectors along which alone the samples know the velocity.
            uncertainty: keep the factor for ``field.std``.
            neighbour: with solver="pcg", an earlier such fit on the same knots, whose factor and coefficients start
                this one (the first frame, and one too unlike its neighbour, are solved directly).
            choice: noise, curvature and slip of another frame's ``field.choice`` in place of a search; outliers are
                judged anew.

        Returns:
            The field. Velocities and weights that require gradients pass them on to it (options fixed, solver "auto"
            or "direct").

        Raises:
            InvalidInput: an argument breaks one of these rules.
            NotConverged: the solver failed.
        """
        where = (divergence_points, box, self.power)
        data = FitData.checked(points, velocity, weight, wall, *where, beam=beam)
        if beam is not None and self.automatic:
            raise InvalidInput("automatic choice needs full vectors: use fixed(...) for samples along a beam")
        traced = data.velocity.requires_grad or data.weight.requires_grad
        if traced and (self.automatic or beam is not None or self.solver not in ("auto", "direct")):
            raise InvalidInput("gradients need fixed(...) options, full vectors and the direct solver")
        problem = self._problem(data, choice)
        name = self._solver_for(problem.system, needs_factor=uncertainty or traced)
        solver = SOLVERS[name]
        if uncertainty and not solver.factors:
            raise InvalidInput(f"solver {name!r} keeps no factor for uncertainty: use 'direct'")
        if traced:
            solved = solve_with_gradient(problem.system, tolerance=self.tolerance, strict=self.strict)
            return problem.field(solved.solution, solved.factor if uncertainty else None)
        start = self._start(neighbour) if solver.starts_from_neighbour else None
        solved = solver.solve(problem.system, self._limits, start)
        kept = solved.factor if uncertainty or solver.starts_from_neighbour else None
        return problem.field(solved.solution, kept, own_factor=start is None)

    def choose(
        self,
        points: torch.Tensor,
        velocity: torch.Tensor,
        weight: torch.Tensor | None = None,
        wall: WallRows | None = None,
        *,
        divergence_points: torch.Tensor | None = None,
        box: tuple[Sequence[float], Sequence[float]] | None = None,
    ) -> Choice | None:
        """What :meth:`fit` would choose from these samples, without the fit itself.

        Args:
            points: as in :meth:`fit`.
            velocity: as in :meth:`fit`.
            weight: as in :meth:`fit`.
            wall: as in :meth:`fit`.
            divergence_points: as in :meth:`fit`.
            box: as in :meth:`fit`.

        Returns:
            The choice, to be given to fits of other frames; None with fixed options and where there is nothing to
            choose from.

        Raises:
            InvalidInput: an argument breaks one of its rules.
        """
        data = FitData.checked(points, velocity, weight, wall, divergence_points, box, self.power)
        return self._grid_and_choice(data)[2]

    def fit_many(
        self,
        points: torch.Tensor,
        velocities: torch.Tensor,
        weight: torch.Tensor | None = None,
        wall: WallRows | None = None,
        *,
        divergence_points: torch.Tensor | None = None,
        box: tuple[Sequence[float], Sequence[float]] | None = None,
        choice: Choice | None = None,
        judged: int | None = None,
    ) -> list[SplineField]:
        """Fit B sets of samples at the same points and weights with one factorisation.

        For ensemble members and frames of a fixed grid.

        Args:
            points: as in :meth:`fit`.
            velocities: (B, n, D), m/s.
            weight: as in :meth:`fit`.
            wall: as in :meth:`fit`.
            divergence_points: as in :meth:`fit`.
            box: as in :meth:`fit`.
            choice: as in :meth:`fit`; None makes one choice for all.
            judged: the number of the set from which that choice is made, and made the same linear estimate of the
                others; None: the mean of all sets.

        Returns:
            B fields.

        Raises:
            InvalidInput: an argument breaks one of these rules.
            NotConverged: the solver failed.
        """
        velocities = torch.as_tensor(velocities)
        if velocities.ndim != 3 or len(velocities) == 0:
            raise InvalidInput(f"velocities have shape {tuple(velocities.shape)}: expected (B, n, D), B >= 1")
        weight = torch.ones(velocities.shape[1]) if weight is None else torch.as_tensor(weight)
        where = (divergence_points, box, self.power)
        every = [FitData.checked(points, v, weight, wall, *where) for v in velocities]
        data = every[judged or 0]
        if judged is None:
            data = replace(data, velocity=torch.stack([d.velocity for d in every]).mean(0))
        problem = self._problem(data, choice)
        return problem.solve_all([one.velocity for one in every], self.tolerance, self.strict)

    def _problem(self, data: FitData, choice: Choice | None = None) -> Problem:
        """The assembled fit; with another frame's ``choice``, noise, curvature and slip are that frame's."""
        knots, options, found = self._grid_and_choice(data, choice)
        if choice is not None:
            return options._following(knots, data, choice)
        if found is None:
            return Problem(data, build_system(options.fixed(), knots, data), None)
        return options._with_choice(knots, data, found)

    def _grid_and_choice(self, data: FitData, given: Choice | None = None) -> tuple[Knots, Self, Choice | None]:
        """Knots, the options in their lengths, and the choice made on them; a given one stays."""
        choice = given
        for per_knot in (SAMPLES_PER_KNOT, SAMPLES_OF_LOW_NOISE):
            knots = knots_for(data, self, per_knot)
            options = self.for_knots(knots.spacing, data.components)
            if given is None:
                choice = choose(options, knots, data) if self.automatic else None
            if self.knots != BY_DATA or choice is None or not _low_noise(choice, data):
                break
        return knots, options, choice

    def _following(self, knots: Knots, data: FitData, choice: Choice) -> Problem:
        """The problem with another frame's noise, curvature and slip, and this frame's own outliers."""
        choice = replace(choice, robust=torch.ones_like(data.weight))
        if self.robust is None:
            return self._with_choice(knots, data, choice)
        # on the knots on which a search judges them too: a fifth of the work
        problem = self._with_choice(knots.spread_out(self.search_knots), data, choice)
        # in single precision first: the residuals' ranks are all that is wanted
        solution, _ = solve_direct(problem.system, tolerance=max(self.tolerance, 1e-4), single=True)
        predicted = problem.field(solution)(data.points, outside=0.0).to(problem.samples.target)
        weight = robust_weight(data.velocity.to(predicted) - predicted, self.robust, data.weight > 0)
        choice = replace(choice, robust=weight.to(data.weight))
        return self._with_choice(knots, data, choice)

    def _with_choice(self, knots: Knots, data: FitData, choice: Choice) -> Problem:
        data = data.reweighed(choice)
        return Problem(data, build_system(self.with_choice(choice), knots, data), choice)

    @property
    def _limits(self) -> Limits:
        return Limits(self.tolerance, self.max_iterations, self.strict, self.sparse)

    def _solver_for(self, system: System, needs_factor: bool) -> str:
        """The solver by name, chosen by size and memory where the option leaves it open."""
        if self.solver != AUTO:
            return self.solver
        device = system.blocks[0].target.device
        return "direct" if needs_factor or band_bytes(system) <= 0.5 * device_memory(device) else "lsmr"

    @staticmethod
    def _start(neighbour: SplineField | None) -> Neighbour | None:
        if neighbour is None:
            return None
        return Neighbour(neighbour.knots, neighbour.coefficients.flatten(1).T, neighbour.factor)


def _low_noise(choice: Choice, data: FitData) -> bool:
    """Whether the noise found is a small part of what the samples show."""
    found = torch.tensor(choice.noise, dtype=torch.float64).square().mean()
    return bool(found < LOW_NOISE**2 * data.velocity.double().square().mean())
