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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, Self

import numpy as np

from .arguments import POSITIVE, between, checked
from .basis.bspline import DEGREES
from .basis.sampling import mean_length
from .errors import InvalidInput
from .solvers.interface import MOST_ITERATIONS
from .solvers.registry import AUTO, SOLVERS
from .statistics.likelihood import LEAST, MOST, Choice
from .statistics.robust import CUTOFFS

SCALINGS = ("density", "thesis")
BY_DATA: Final = "auto"  # of a length or a time: from the distance between samples
# Three samples between knots: a kernel of three voxels, the usual one, leaves nothing finer, and noise is averaged. Two
# where the noise found is less than LOW_NOISE of the flow: then it is mostly what wider knots do not resolve.
SAMPLES_PER_KNOT, SAMPLES_OF_LOW_NOISE, LOW_NOISE = 3.0, 2.0, 0.2
DIVERGENCE = 10.0  # knot distances
CURVATURE = 3.0  # to a knot distance; the first guess of a search
Length = float | Literal["auto"]
MOST_DISTANCE = 1e9  # m or s: beyond it products underflow
LENGTHS = ("divergence", "curvature", "time_curvature")  # that a number of knots stands for
AUTOMATIC = (None, "likelihood", "gcv")
RANGES = {
    "max_iterations": between(1, MOST_ITERATIONS),
    "rounds": between(1, 10_000),
    "tolerance": POSITIVE,
    "search_knots": between(1.0, 1e6),
}


def length_of(value: Length | None) -> float:
    """The number of a length or a time that is set; 0 for None. InvalidInput where the data have still to decide."""
    if isinstance(value, str):
        raise InvalidInput("lengths are still to be decided by the data: fill them in by for_knots")
    return 0.0 if value is None else value


@checked(**RANGES)
@dataclass(frozen=True)
class SplineOptions:
    """Options of the spline fit; ``None`` switches a part off. See the module's text for the units.

    Args:
        knots: m, knot distance, one number or one per axis; "auto": three times the distance between samples, along
            each axis of a grid, or twice where an automatic choice finds little noise, and no less than
            ``resolution``; wider where factoring would take more work than a fixed number of operations per sample.
        spacing: m, distances between samples along the axes where they are known (of a grid, x first); None: found
            from the samples.
        resolution: m, full width at half maximum over which the measurement averages, where it is known to be more
            than three samples.
        nodes: coefficients per axis instead, longest side first (Grønli 2017, table 4.1: 32, 16, 16).
        time_knots: s, knot distance along the time, for points with a time column; "auto": three frames.
        degree: of the splines, 1 to 5.
        divergence: m, strength of div v = 0; "auto": ten knot distances.
        wall: strength of the walls' normal velocity, a ratio.
        no_slip: strength of the walls' full velocity, a ratio.
        curvature: m, strength of smoothness; "auto": a third of the knot distance.
        time_curvature: s; adds time_curvature^4 <|d^2 v / dt^2|^2> to the cost and keeps its ratio to curvature where
            that is chosen automatically; "auto": a third of time_knots.
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

    knots: Length | tuple[float, ...] | None = BY_DATA
    spacing: tuple[float, ...] | None = None
    resolution: float | None = None
    nodes: tuple[int, ...] | None = None
    time_knots: Length | None = BY_DATA
    degree: int = 3
    divergence: Length | None = BY_DATA
    wall: float | None = 2.0
    no_slip: float | None = 0.5
    curvature: Length | None = BY_DATA
    time_curvature: Length | None = BY_DATA
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
            raise InvalidInput("give exactly one of knots (a distance in m, or 'auto') and nodes (a count per axis)")
        if self.nodes is not None and min(self.nodes) <= self.degree:
            raise InvalidInput(f"nodes is {self.nodes}: each axis needs more than degree = {self.degree}")
        for name in ("divergence", "wall", "no_slip", "curvature", "time_curvature", "damping"):
            value = getattr(self, name)
            if value == BY_DATA and name in LENGTHS:
                continue
            if value is not None and (isinstance(value, str) or not (value == 0 or LEAST < value < MOST)):
                rule = f"0, or from {LEAST:g} to {MOST:g}, or None to switch it off"
                raise InvalidInput(f"{name} is {value!r}: it must be {rule}")
        self._check_distances()
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
        self._check_combinations()

    def _check_distances(self) -> None:
        others = (("spacing", self.spacing), ("resolution", self.resolution))
        for name, value in (("knots", self.knots), ("time_knots", self.time_knots), *others):
            if value is None or (value == BY_DATA and "knots" in name):
                continue
            each = value if isinstance(value, tuple | list) else (value,)
            if not all(isinstance(one, int | float | np.number) and 0 < one < MOST_DISTANCE for one in each):
                raise InvalidInput(f"{name} is {value!r}: it must be a positive distance, in m (time_knots: s)")

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

    def knots_at(self, steps: Sequence[float], per_knot: float = SAMPLES_PER_KNOT) -> tuple[float, ...]:
        """Knot distances (D,), m: given, or for samples ``steps`` (D,) m apart, ``per_knot`` of them to a knot."""
        if self.knots != BY_DATA:
            given = self.knots if isinstance(self.knots, tuple | list) else (length_of(self.knots),) * len(steps)
            return tuple(given)
        return tuple(max(per_knot * step, self.resolution or 0.0) for step in steps)

    def for_knots(self, spacing: Sequence[float], components: int) -> Self:
        """The same options with numbers for all lengths and times that the data were to decide.

        Args:
            spacing: A knot distances, m, with that along the time (s) as a last one where there is one.
            components: D.
        """
        length = mean_length(spacing[:components])
        known: dict[str, Any] = {}
        if self.divergence == BY_DATA:
            known["divergence"] = DIVERGENCE * length
        if self.curvature == BY_DATA:
            known["curvature"] = length / CURVATURE
        if self.time_curvature == BY_DATA:
            known["time_curvature"] = spacing[-1] / CURVATURE if len(spacing) > components else None
        return replace(self, **known) if known else self

    def with_choice(self, choice: Choice) -> Self:
        """The same options, fixed at what was chosen."""
        curvature, in_time = length_of(self.curvature), self.time_curvature
        if in_time is not None and curvature:
            in_time = choice.curvature / curvature * length_of(in_time)
        free = self.divergence if choice.divergence is None else choice.divergence
        return self.fixed(time_curvature=in_time, curvature=choice.curvature, no_slip=choice.no_slip, divergence=free)
