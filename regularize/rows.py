"""From checked samples and options to the row blocks of the system."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import TYPE_CHECKING

import torch
from scipy.spatial import ConvexHull, QhullError

from .errors import InvalidInput
from .knots import Knots
from .operators import CellRows, DirectionRows, DivergenceRows, RowBlock, System, VectorRows
from .penalties import curvature_gram, divergence_gram, row_factor
from .walls import WallRows

if TYPE_CHECKING:
    from .likelihood import Choice
    from .smoother import Smoother


@dataclass(frozen=True)
class FitData:
    """Samples of positive weight, walls and divergence points inside the box, in one dtype."""

    points: torch.Tensor  # (n, D) m
    velocity: torch.Tensor  # (n, D) m/s
    weight: torch.Tensor  # (n,) row weights: confidence ** power
    wall: WallRows | None
    divergence_points: torch.Tensor | None
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    left_out: int  # wall and divergence points beyond a given box
    component_weight: torch.Tensor  # (C,) row factors, root mean square 1: components differ in noise

    @classmethod
    def checked(
        cls,
        points: torch.Tensor,
        velocity: torch.Tensor,
        weight: torch.Tensor | None,
        wall: WallRows | None,
        divergence_points: torch.Tensor | None,
        box: tuple[Sequence[float], Sequence[float]] | None,
        power: float,
    ) -> "FitData":
        points, velocity, weight = _checked_samples(points, velocity, weight)
        wall = None if wall is None else wall.to(points.dtype, points.device)
        extra = None if divergence_points is None else torch.as_tensor(divergence_points).to(points)
        for name, more in (
            ("wall points", None if wall is None else wall.points),
            ("divergence_points", extra),
        ):
            if more is not None and (more.ndim != 2 or more.shape[1] != points.shape[1]):
                raise InvalidInput(f"{name} have shape {tuple(more.shape)}: expected (m, {points.shape[1]})")
        left_out = 0
        if box is None:
            everything = (
                [points] + ([] if wall is None else [wall.points]) + ([] if extra is None else [extra])
            )
            together = torch.cat(everything)
            lower, upper = together.amin(0), together.amax(0)
        else:
            lower, upper = _checked_box(box, points)
            if wall is not None:
                keep = ((wall.points >= lower) & (wall.points <= upper)).all(1)
                left_out += int((~keep).sum())
                wall = wall.subset(keep) if bool(keep.any()) else None
            if extra is not None:
                keep = ((extra >= lower) & (extra <= upper)).all(1)
                left_out += int((~keep).sum())
                extra = extra[keep]
        return cls(
            points,
            velocity,
            weight**power,
            wall,
            extra,
            tuple(lower.tolist()),
            tuple(upper.tolist()),
            left_out,
            torch.ones_like(points[0]),
        )

    def reweighed(self, choice: "Choice") -> "FitData":
        """With the robust factors and component noise that an automatic choice found."""
        precision = torch.tensor(choice.noise, dtype=torch.float64) ** -2
        each = (precision / precision.mean()).sqrt().to(self.points)
        # discarded samples stay as rows of weight 0: the field remains defined where they lie
        return replace(self, weight=self.weight * choice.robust.sqrt(), component_weight=each)

    def extent(self, knots: Knots) -> float:
        """Volume over which penalties are averaged: that of the data, or of one knot cell for flat data."""
        return self.volume() or prod(knots.spacing)

    def volume(self) -> float:
        """Volume (area in 2-D) that samples and walls span, m^D; 0 where they lie in one plane."""
        cloud = self.points if self.wall is None else torch.cat([self.points, self.wall.points])
        try:
            return float(ConvexHull(cloud.double().cpu().numpy()).volume)
        except (QhullError, ValueError):  # fewer than D + 1 points, or all in one plane
            return 0.0


def _checked_samples(
    points: torch.Tensor, velocity: torch.Tensor, weight: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    velocity = torch.as_tensor(velocity)
    if not velocity.is_floating_point():
        velocity = velocity.double()
    points = torch.as_tensor(points).to(velocity)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or velocity.shape != points.shape:
        raise InvalidInput(
            f"points have shape {tuple(points.shape)} and velocity {tuple(velocity.shape)}: both "
            "must be (n, D) with D = 2 or 3"
        )
    weight = torch.ones_like(points[:, 0]) if weight is None else torch.as_tensor(weight).to(velocity)
    if weight.shape != points.shape[:1]:
        raise InvalidInput(f"weight has shape {tuple(weight.shape)}: expected ({len(points)},)")
    if not bool(((weight >= 0) & torch.isfinite(weight)).all()):
        raise InvalidInput("weight has negative or non-finite entries: weights must be finite and >= 0")
    keep = weight > 0
    if not bool(keep.any()):
        raise InvalidInput("no sample has a positive weight: there is nothing to fit")
    points, velocity, weight = points[keep], velocity[keep], weight[keep]
    if not bool(torch.isfinite(points).all() and torch.isfinite(velocity).all()):
        raise InvalidInput(
            "points or velocity hold NaN or infinity at a positive weight: set its weight to 0"
        )
    return points, velocity, weight


def _checked_box(
    box: tuple[Sequence[float], Sequence[float]], points: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    lower, upper = (torch.as_tensor(side, dtype=points.dtype, device=points.device) for side in box)
    if lower.shape != points.shape[1:] or upper.shape != lower.shape or not bool((upper > lower).all()):
        raise InvalidInput(
            f"box is {box}: expected (lower, upper) corners with {points.shape[1]} numbers each "
            "and upper > lower"
        )
    slack = 1e-6 * (upper - lower)
    outside = int((~((points >= lower - slack) & (points <= upper + slack)).all(1)).sum())
    if outside:
        raise InvalidInput(
            f"{outside} samples of positive weight lie outside the box: enlarge it or give them weight 0"
        )
    return lower, upper


def knots_for(
    data: FitData, spacing: float | Sequence[float] | None, nodes: Sequence[int] | None, degree: int
) -> Knots:
    """The knot grid around the data: of a given spacing, or of given counts with the longest side first."""
    sides = [b - a for a, b in zip(data.lower, data.upper, strict=True)]
    if nodes is None:
        each = [spacing] * len(sides) if isinstance(spacing, int | float) else list(spacing)
        if len(each) != len(sides):
            raise InvalidInput(f"knots has {len(each)} entries for {len(sides)} axes")
        return Knots.covering(data.lower, data.upper, each, degree)
    if len(nodes) < len(sides):
        raise InvalidInput(f"nodes has {len(nodes)} entries for {len(sides)} axes")
    counts = sorted(nodes, reverse=True)[: len(sides)]
    cells = [0] * len(sides)
    for rank, axis in enumerate(sorted(range(len(sides)), key=lambda k: -sides[k])):
        cells[axis] = counts[rank] - degree
    longest = max(max(sides), 1e-12)
    # A box flat along an axis still needs a positive spacing there.
    step = [max(side, 1e-3 * longest) / n for side, n in zip(sides, cells, strict=True)]
    origin = [(a + b - n * h) / 2 for a, b, n, h in zip(data.lower, data.upper, cells, step, strict=True)]
    return Knots(tuple(origin), tuple(step), tuple(cells), degree)


def build_system(options: "Smoother", knots: Knots, data: FitData) -> System:
    """The rows of thesis eq. 3.22 (plus no-slip and curvature) with the options' scaling."""
    return (
        _thesis_system(options, knots, data)
        if options.scaling == "thesis"
        else _density(options, knots, data)
    )


def _thesis_system(options: "Smoother", knots: Knots, data: FitData) -> System:
    components = data.velocity.shape[1]
    blocks = [VectorRows(knots, data.points, data.velocity, data.weight[:, None])]
    if options.divergence:
        where = data.points if data.divergence_points is None else data.divergence_points
        per_spacing = options.divergence * sum(knots.spacing) / len(knots.spacing)
        blocks.append(DivergenceRows(knots, where, components, torch.full_like(where[:, 0], per_spacing)))
    if data.wall is not None:
        root = data.wall.weight.sqrt()
        blocks += _wall_blocks(knots, data.wall, options.wall, options.no_slip, root)
    if options.curvature:
        raise InvalidInput("curvature has no thesis meaning: set it to None, or use scaling='density'")
    return System(knots, components, blocks, options.damping or 0.0)


def _density(options: "Smoother", knots: Knots, data: FitData) -> System:
    components = data.velocity.shape[1]
    weight = data.weight[:, None] * data.component_weight
    share = data.weight.double().square().sum().sqrt().to(weight)
    fit = VectorRows(knots, data.points, data.velocity, weight / share)
    blocks, _, damping = penalty_blocks(options, knots, data, [fit])
    return System(knots, components, [fit, *blocks], damping)


def penalty_blocks(
    options: "Smoother", knots: Knots, data: FitData, fit: list[RowBlock]
) -> tuple[list[RowBlock], torch.Tensor, float]:
    """Rows of all penalties in the density scaling, the cells they cover, and the damping's row factor."""
    components = data.velocity.shape[1]
    extent = data.extent(knots)
    blocks: list[RowBlock] = []
    if data.wall is not None and float(data.wall.weight.sum()) > 0:
        blocks += _wall_blocks(knots, data.wall, options.wall, options.no_slip, wall_roots(data.wall))
    where = data.divergence_points
    if where is not None and len(where) and options.divergence:
        each = torch.full_like(where[:, 0], options.divergence / len(where) ** 0.5)
        blocks.append(DivergenceRows(knots, where, components, each))
    cells = torch.unique(torch.cat([knots.cell_number(block.cell) for block in [*fit, *blocks]]))
    cells = knots.cell_index(cells)
    if where is None and options.divergence:
        factor = row_factor(divergence_gram(knots, components), components).to(data.points)
        blocks.append(CellRows(knots, cells, options.divergence / extent**0.5 * factor, components))
    if options.curvature:
        factor = row_factor(curvature_gram(knots, range(knots.axes))).to(data.points)
        blocks.append(CellRows(knots, cells, options.curvature**2 / extent**0.5 * factor, components))
    return blocks, cells, (options.damping or 0.0) * (prod(knots.spacing) / extent) ** 0.5


def wall_roots(wall: WallRows) -> torch.Tensor:
    """(n,) row factors that turn sums over wall rows into means."""
    return (wall.weight / wall.weight.sum()).sqrt()


def _wall_blocks(
    knots: Knots, wall: WallRows, normal: float | None, no_slip: float | None, root: torch.Tensor
) -> list:
    """Normal rows at every wall point, full-vector rows where the wall holds the blood."""
    blocks = []
    if normal:
        target = (wall.normals * wall.velocity).sum(1)
        blocks.append(DirectionRows(knots, wall.points, wall.normals, target, normal * root))
    held = wall.no_slip
    if no_slip and bool(held.any()):
        blocks.append(
            VectorRows(knots, wall.points[held], wall.velocity[held], (no_slip * root[held])[:, None])
        )
    return blocks
