"""The options of the spline fit, their meaning and their checks; everything that reads them imports this file.

The cost (options in physical units, ``scaling="density"``) is a sum of averages,

    J(v) = <|v - v_i|^2>_samples + divergence^2 <(div v)^2>_fluid + wall^2 <(n.(v - v_w))^2>_walls
           + no_slip^2 <|v - v_w|^2>_walls + curvature^4 <|grad grad v|^2>_fluid + damping^2 <|v|^2>_fluid

(with ``order`` m other than 2, curvature^2m and the m-th derivatives), so that no number changes its meaning with
the grid, the number of samples or the size of the box: wall, no_slip and damping are ratios, divergence and curvature
lengths (curvature halves wavelengths of 2 pi curvature). Averages over samples are weighted by weight^(2 power), ones
over walls by WallRows.weight.
``scaling="thesis"`` is the cost of Grønli 2017, eq. 3.22 with sums, derivatives per mean knot spacing and divergence
rows at the samples (BIBLIOGRAPHY.md has our corrections), the meaning that the settings of its table 4.1 need.
"""

from dataclasses import dataclass, replace
from typing import Any, Self

from .basis.bspline import DEGREES
from .errors import InvalidInput
from .solvers.registry import AUTO, SOLVERS
from .statistics.likelihood import Choice
from .statistics.robust import CUTOFFS

SCALINGS = ("density", "thesis")
AUTOMATIC = (None, "likelihood", "gcv")


@dataclass(frozen=True)
class SplineOptions:
    """Options of the spline fit; ``None`` switches a part off. See the module's text for the units.

    Args:
        knots: m, knot distance, one number or one per axis.
        nodes: coefficients per axis instead, longest side first (Grønli 2017, table 4.1: 32, 16, 16).
        time_knots: s, knot distance along the time, for points with a time column.
        degree: of the splines, 1 to 5.
        divergence: m, strength of div v = 0.
        wall: strength of the walls' normal velocity, a ratio.
        no_slip: strength of the walls' full velocity, a ratio.
        curvature: m, strength of smoothness.
        time_curvature: s; adds time_curvature^4 <|d^2 v / dt^2|^2> to the cost and keeps its ratio to curvature where
            that is chosen automatically.
        order: of the derivatives that curvature and time_curvature penalise, at most ``degree``; 3 fills gaps in
            exact, smooth data better.
        damping: of the coefficients, a ratio.
        power: samples' rows are multiplied by weight ** power.
        automatic: "likelihood" chooses curvature, no_slip and the noise of each velocity component from the data (see
            ``statistics.likelihood``), "gcv" curvature alone, believing all samples independent (see
            ``statistics.gcv``). The values given here are then the first guess, and are kept where fewer than 30
            samples, or samples of no flow, leave nothing to choose from (``field.choice`` is None there).
        robust: "tukey" or "huber" reweighting of outliers, found together with that choice.
        choose_divergence: the likelihood chooses divergence too. Only for samples of independent errors: it takes the
            divergence of errors that are correlated over millimetres (speckle tracking) for flow, and settles on too
            weak a penalty.
        correlated: samples whose errors are found to be correlated over several samples (see
            ``statistics.correlated``) weigh less beside the penalties; for full vectors in space, with
            automatic="likelihood".
        search_knots: the choice is made on a grid this many times coarser.
        rounds: of the search, at most.
        scaling: "density" or "thesis", see above.
        solver: "direct", "direct32" (a float32 factor, refined to the tolerance: half the time on large grids),
            "lsqr", "lsmr", or "pcg" with a neighbouring frame's factor; "auto" is direct, or LSMR where the factor
            would fill more than half of the device's memory.
        sparse: the iterative solvers store the matrix and its transpose instead of applying rows.
        tolerance: true relative gradient at which a solver may stop.
        max_iterations: of an iterative solver.
        strict: NotConverged where the tolerance cannot be reached; else the field comes as it is, and
            ``field.solution`` says how far that is.

    Raises:
        InvalidInput: an option out of its range, or options that exclude each other.
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
            ("solver", (AUTO, *SOLVERS)),
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
    def preset(cls, name: str, **changes: Any) -> Self:
        """Options by name, with ``changes``.

        Args:
            name: "default", or "thesis" for the settings of Grønli 2017, table 4.1 (32x16x16 coefficients, damping
                0.5, lambda 500, kappa 200, power 2).
            **changes: fields that differ from it.

        Raises:
            InvalidInput: another name, or changes that do not fit.
        """
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

    def fixed(self, **changes: Any) -> Self:
        """The same options without automatic choice and reweighting, with ``changes``."""
        off: dict[str, Any] = {"automatic": None, "robust": None, "choose_divergence": False}
        return replace(self, **off | changes)

    def with_choice(self, choice: Choice) -> Self:
        """The same options, fixed at what was chosen."""
        in_time = self.time_curvature
        if in_time is not None and self.curvature:
            in_time = choice.curvature / self.curvature * in_time
        free = self.divergence if choice.divergence is None else choice.divergence
        return self.fixed(time_curvature=in_time, curvature=choice.curvature, no_slip=choice.no_slip, divergence=free)
