"""The penalised B-spline smoother: options, presets, and the fit of one velocity field.

The cost (options in physical units, ``scaling="density"``) is a sum of averages,

    J(v) = <|v - v_i|^2>_samples + divergence^2 <(div v)^2>_fluid + wall^2 <(n.(v - v_w))^2>_walls
           + no_slip^2 <|v - v_w|^2>_walls + curvature^4 <|grad grad v|^2>_fluid + damping^2 <|v|^2>_fluid

(with ``order`` m other than 2, curvature^2m and the m-th derivatives), so that no number changes its meaning with
the grid, the number of samples or the size of the box: wall, no_slip and damping are ratios, divergence and curvature
lengths (curvature halves wavelengths of 2 pi curvature). Averages over samples are weighted by weight^(2 power), ones
over walls by WallRows.weight.
``scaling="thesis"`` is eq. 3.22 with sums, derivatives per mean knot spacing and divergence rows at the
samples (ERRATA 3.17, 3.23), the meaning that table 4.1 needs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from regularize.basis.bspline import DEGREES
from regularize.basis.knots import Knots
from regularize.errors import InvalidInput
from regularize.rows.operators import System
from regularize.rows.sparse import sparse_operators
from regularize.rows.walls import WallRows
from regularize.solvers.direct import Factor, PreparedSystem, solve_direct
from regularize.solvers.implicit import solve_with_gradient
from regularize.solvers.krylov import Solution, lsqr
from regularize.solvers.lsmr import lsmr
from regularize.solvers.memory import band_bytes, device_memory
from regularize.solvers.pcg import pcg
from regularize.statistics.likelihood import Choice
from regularize.statistics.robust import CUTOFFS, robust_weight

from .field import SplineField
from .problem import Problem
from .row_blocks import build_system, knots_for
from .samples import FitData
from .search import choose

SOLVERS = ("auto", "direct", "direct32", "lsqr", "lsmr", "pcg")
WITHOUT_FACTOR = ("direct32", "lsqr", "lsmr")  # none in float64 that an uncertainty could rest on
NEIGHBOUR_ITERATIONS = 25  # about what a factorisation costs
SCALINGS = ("density", "thesis")
AUTOMATIC = (None, "likelihood", "gcv")


@dataclass(frozen=True)
class Smoother:
    """Options of the spline fit; ``None`` switches a part off. See the module's text for the units.

    ``knots``: knot distance in m (or one per axis); ``nodes`` instead fixes the coefficients per axis,
    longest side first (table 4.1: 32, 16, 16). ``time_knots`` (s): knot distance along the time, for points
    with a time column; ``time_curvature`` (s) adds time_curvature^4 <|d^2 v / dt^2|^2> to the cost and keeps
    its ratio to curvature where that is chosen automatically. ``order``: of the derivatives that curvature (and
    time_curvature) penalises, at most ``degree``; 3 fills gaps in exact, smooth data better. ``power``: samples'
    rows are multiplied by weight ** power. ``automatic="likelihood"`` chooses curvature, no_slip and the noise of
    each velocity component from the data (see ``likelihood``), "gcv" curvature alone, believing all samples
    independent (see ``gcv``); the values given here are then the first guess, and are kept where fewer than 30
    samples, or samples of no flow, leave nothing to choose from (``field.choice`` is None there). ``robust``: "tukey"
    or "huber" reweighting of outliers, found together with that choice. ``choose_divergence``: the likelihood
    chooses divergence too. Only for samples of independent errors: the likelihood takes the divergence of errors that
    are correlated over millimetres (speckle tracking) for flow, and settles on too weak a penalty.
    ``correlated``: samples whose errors are found to be correlated over several samples (see ``correlated``) weigh
    less beside the penalties; for full vectors in space, with automatic="likelihood".
    ``search_knots``: the choice is made on a grid this many times coarser, in at most ``rounds`` rounds.
    ``solver``: "direct", "direct32" (a float32 factor, refined to the tolerance: half the time on large grids),
    "lsqr", "lsmr", or "pcg" with a neighbouring frame's factor; "auto" is direct, or LSMR where the factor would fill
    more than half of the device's memory. ``sparse``: the iterative ones store the matrix and its transpose instead
    of applying rows. ``tolerance``: true relative gradient at which a solver may stop. ``strict``: NotConverged
    where it cannot be reached; else the field comes as it is, and ``field.solution`` says how far that is.
    """

    knots: float | tuple[float, ...] | None = 3e-3
    nodes: tuple[int, ...] | None = None
    time_knots: float | None = None
    degree: int = 3
    divergence: float | None = 30e-3
    wall: float | None = 2.0
    no_slip: float | None = 0.5
    curvature: float | None = 1e-3
    time_curvature: float | None = 10e-3
    order: int = 2
    damping: float | None = 1e-5
    power: float = 1.0
    automatic: str | None = "likelihood"
    robust: str | None = "tukey"
    choose_divergence: bool = False
    correlated: bool = True
    search_knots: float = 4 / 3
    rounds: int = 12
    scaling: str = "density"
    solver: str = "auto"
    sparse: bool = False
    tolerance: float = 1e-6
    max_iterations: int = 5000
    strict: bool = True

    def __post_init__(self) -> None:
        if (self.knots is None) == (self.nodes is None):
            raise InvalidInput("give exactly one of knots (a distance in m) and nodes (a count per axis)")
        if self.nodes is not None and min(self.nodes) <= self.degree:
            raise InvalidInput(f"nodes is {self.nodes}: each axis needs more than degree = {self.degree}")
        for name in ("divergence", "wall", "no_slip", "curvature", "time_curvature", "damping"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < float("inf"):
                raise InvalidInput(f"{name} is {value}: it must be finite and >= 0, or None to switch it off")
        if not 1 <= self.order <= self.degree and self.curvature:
            raise InvalidInput(f"order is {self.order}: it must lie between 1 and degree = {self.degree}")
        if self.power < 0:
            raise InvalidInput(f"power is {self.power}: it must be >= 0")
        for name, known in (
            ("degree", DEGREES),
            ("solver", SOLVERS),
            ("scaling", SCALINGS),
            ("automatic", AUTOMATIC),
            ("robust", (None, *CUTOFFS)),
        ):
            if getattr(self, name) not in known:
                raise InvalidInput(f"{name} is {getattr(self, name)!r}: choose one of {known}")
        if self.tolerance <= 0 or self.max_iterations < 1 or self.rounds < 1 or self.search_knots < 1:
            raise InvalidInput("tolerance must be > 0; max_iterations, rounds and search_knots >= 1")
        self._check_combinations()

    def _check_combinations(self) -> None:
        if self.automatic and (self.scaling == "thesis" or not self.curvature):
            raise InvalidInput("automatic choice needs scaling='density' and a curvature > 0 to start from")
        if self.robust and not self.automatic:
            raise InvalidInput("robust reweighting runs within the automatic choice: set robust=None")
        if self.choose_divergence and (self.automatic != "likelihood" or not self.divergence):
            raise InvalidInput("choose_divergence needs automatic='likelihood' and a divergence > 0 to start from")

    @classmethod
    def preset(cls, name: str, **changes: object) -> "Smoother":
        """``default``, or ``thesis``: table 4.1 (32x16x16, damping 0.5, lambda 500, kappa 200, power 2)."""
        if name == "default":
            return replace(cls(), **changes)
        if name == "thesis":
            table = cls(
                knots=None,
                nodes=(32, 16, 16),
                divergence=500.0,
                wall=200.0,
                no_slip=None,
                curvature=None,
                damping=0.5,
                power=2.0,
                automatic=None,
                robust=None,
                scaling="thesis",
            )
            return replace(table, **changes)
        raise InvalidInput(f"preset is {name!r}: choose 'default' or 'thesis'")

    def fixed(self, **changes: object) -> "Smoother":
        """The same options without automatic choice and reweighting, with ``changes``."""
        return replace(self, **{"automatic": None, "robust": None, "choose_divergence": False} | changes)

    def with_choice(self, choice: Choice) -> "Smoother":
        """The same options, fixed at what was chosen."""
        in_time = None if self.time_curvature is None else choice.curvature / self.curvature * self.time_curvature
        free = self.divergence if choice.divergence is None else choice.divergence
        chosen = {"curvature": choice.curvature, "no_slip": choice.no_slip, "divergence": free}
        return self.fixed(time_curvature=in_time, **chosen)

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
        """Fit samples velocity (n, D) in m/s at points (n, D) in m with confidences weight (n,) in [0, 1].

        Points (n, D + 1) carry the time in s last; walls, divergence points and the field's arguments then do
        too. ``beam`` (n, D) or (D,): unit vectors along which alone the samples know the velocity.
        ``wall``: rows on walls and valves. ``divergence_points`` (m, D): where the divergence is penalised
        (and the field counts as supported); absent: over every knot cell that holds samples or wall.
        ``box``: lower and upper corner of the knot grid (default: around all points); give the same one for
        all frames of a recording. ``uncertainty``: keep the factor for ``field.std``. ``neighbour``: with
        solver="pcg", an earlier such fit on the same knots, whose factor and coefficients start this one (the
        first frame, and one too unlike its neighbour, are solved directly). ``choice``: noise, curvature and
        slip of another frame's ``field.choice`` in place of a search; outliers are judged anew. Velocities
        and weights that require gradients pass them on to the field (options fixed, solver "auto" or
        "direct"). Samples of zero weight are ignored and may be NaN. Raises InvalidInput for bad input,
        NotConverged when the solver fails.
        """
        where = (divergence_points, box, self.power)
        data = FitData.checked(points, velocity, weight, wall, *where, beam=beam)
        if beam is not None and self.automatic:
            raise InvalidInput("automatic choice needs full vectors: use fixed(...) for samples along a beam")
        traced = data.velocity.requires_grad or data.weight.requires_grad
        if traced and (self.automatic or beam is not None or self.solver not in ("auto", "direct")):
            raise InvalidInput("gradients need fixed(...) options, full vectors and the direct solver")
        problem = self._problem(data) if choice is None else self._following(data, choice)
        if self.solver == "pcg" and neighbour is not None:
            solution, factor = self._with_neighbour(problem.system, neighbour)
            return problem.field(solution, factor, own_factor=False)
        solver = self._solver(problem.system, needs_factor=uncertainty or traced)
        if solver in WITHOUT_FACTOR:
            if uncertainty:
                raise InvalidInput(f"solver {solver!r} keeps no factor for uncertainty: use 'direct'")
            return problem.field(self._without_factor(problem.system, solver))
        solve = solve_with_gradient if traced else solve_direct
        solution, factor = solve(problem.system, tolerance=self.tolerance, strict=self.strict)
        return problem.field(solution, factor if uncertainty or solver == "pcg" else None)

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
        """Fit B sets of samples velocities (B, n, D) at the same points and weights with one factorisation.

        For ensemble members and frames of a fixed grid. Automatic choice is made once, from their mean, or from the
        set number ``judged``: the same linear estimate is then made of the others. ``choice`` as in :meth:`fit`.
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
        problem = self._problem(data) if choice is None else self._following(data, choice)
        return problem.solve_all([one.velocity for one in every], self.tolerance, self.strict)

    def _problem(self, data: FitData) -> Problem:
        knots = knots_for(data, self)
        choice = choose(self, knots, data) if self.automatic else None
        if choice is not None:
            return self._with_choice(knots, data, choice)
        return Problem(data, build_system(self.fixed(), knots, data), None)

    def _following(self, data: FitData, choice: Choice) -> Problem:
        """The problem with another frame's noise, curvature and slip, and this frame's own outliers."""
        choice = replace(choice, robust=torch.ones_like(data.weight))
        problem = self._with_choice(knots_for(data, self), data, choice)
        if self.robust is None:
            return problem
        solution, _ = solve_direct(problem.system, tolerance=max(self.tolerance, 1e-4))
        fit = problem.system.blocks[0]
        predicted = problem.field(solution)(data.points, outside=0.0).to(fit.target)
        weight = robust_weight(data.velocity.to(predicted) - predicted, self.robust, data.weight > 0)
        choice = replace(choice, robust=weight.to(data.weight))
        return self._with_choice(problem.system.knots, data, choice)

    def _with_choice(self, knots: Knots, data: FitData, choice: Choice) -> Problem:
        data = data.reweighed(choice)
        return Problem(data, build_system(self.with_choice(choice), knots, data), choice)

    def _solver(self, system: System, needs_factor: bool) -> str:
        """The solver by name, chosen by size and memory where the option leaves it open."""
        if self.solver != "auto":
            return self.solver
        device = system.blocks[0].target.device
        return "direct" if needs_factor or band_bytes(system) <= 0.5 * device_memory(device) else "lsmr"

    def _without_factor(self, system: System, solver: str) -> Solution:
        options = {"tolerance": self.tolerance, "strict": self.strict}
        if solver == "direct32":
            return solve_direct(system, single=True, **options)[0]
        method = lsqr if solver == "lsqr" else lsmr
        apply = sparse_operators(system) if self.sparse else (system.matvec, system.rmatvec)
        options["max_iterations"] = self.max_iterations
        return method(*apply, system.target(), damping=system.damping, **options)

    def _with_neighbour(self, system: System, neighbour: SplineField) -> tuple[Solution, Factor]:
        if neighbour.factor is None or neighbour.knots != system.knots:
            raise InvalidInput(
                "neighbour holds no factor of the same knot grid: fit it with solver='pcg' and the same box"
            )
        start, prepared = neighbour.coefficients.flatten(1).T, PreparedSystem(system)
        limits = {"tolerance": self.tolerance, "max_iterations": NEIGHBOUR_ITERATIONS, "strict": False}
        solution = pcg(prepared, neighbour.factor, start=start, **limits)
        if solution.gradient <= self.tolerance:
            return solution, neighbour.factor
        # a neighbour too different costs more iterations than a factorisation of its own
        return solve_direct(prepared, tolerance=self.tolerance, strict=self.strict)
