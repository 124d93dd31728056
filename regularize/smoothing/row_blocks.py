"""From checked samples and options to the row blocks of the system."""

from math import prod

import numpy as np
import torch

from regularize.basis.knots import Knots
from regularize.errors import InvalidInput
from regularize.options import SplineOptions
from regularize.rows.operators import CellRows, DirectionRows, DivergenceRows, RowBlock, System, VectorRows
from regularize.rows.penalties import curvature_gram, divergence_gram, row_factor
from regularize.rows.walls import WallRows

from .samples import FitData


def knots_for(data: FitData, options: SplineOptions) -> Knots:
    """The knot grid around the data: of a given spacing, or of given counts with the longest side first."""
    sides = [b - a for a, b in zip(data.lower, data.upper, strict=True)]
    if options.nodes is not None:
        if data.over_time:
            raise InvalidInput("nodes fixes a grid in space alone: over time give knots and time_knots")
        return _knots_of_counts(data, options.nodes, sides, options.degree)
    spacing, space = options.knots, data.components
    each = [float(spacing)] * space if isinstance(spacing, int | float) else list(spacing or ())
    if data.over_time:
        if options.time_knots is None:
            raise InvalidInput("points hold a time column: give time_knots, the knot distance in s")
        each.append(options.time_knots)
    if len(each) != len(sides):
        raise InvalidInput(f"knots has {len(each)} entries for {len(sides)} axes")
    return Knots.covering(data.lower, data.upper, each, options.degree)


def _knots_of_counts(data: FitData, nodes: tuple[int, ...], sides: list[float], degree: int) -> Knots:
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


def build_system(options: SplineOptions, knots: Knots, data: FitData) -> System:
    """The rows of Grønli 2017, eq. 3.22 (plus no-slip and curvature) with the options' scaling."""
    return _thesis_system(options, knots, data) if options.scaling == "thesis" else _density(options, knots, data)


def _thesis_system(options: SplineOptions, knots: Knots, data: FitData) -> System:
    components = data.components
    blocks: list[RowBlock] = [sample_rows(knots, data, data.weight[:, None])]
    if options.divergence:
        where = data.points if data.divergence_points is None else data.divergence_points
        per_spacing = options.divergence * sum(knots.spacing[:components]) / components
        blocks.append(DivergenceRows(knots, where, components, torch.full_like(where[:, 0], per_spacing)))
    if data.wall is not None:
        root = data.wall.weight.sqrt()
        blocks += _wall_blocks(knots, data.wall, options.wall, options.no_slip, root)
    if options.curvature:
        raise InvalidInput("curvature has no thesis meaning: set it to None, or use scaling='density'")
    return System(knots, components, blocks, options.damping or 0.0)


def _density(options: SplineOptions, knots: Knots, data: FitData) -> System:
    weight = data.weight[:, None] * data.component_weight
    share = data.weight.double().square().sum().sqrt().to(weight)
    fit = sample_rows(knots, data, weight / share)
    blocks, _, damping = penalty_blocks(options, knots, data, [fit])
    return System(knots, data.components, [fit, *blocks], damping)


def sample_rows(knots: Knots, data: FitData, weight: torch.Tensor) -> VectorRows | DirectionRows:
    """Rows of the samples, row weights (n, D) or (n, 1): full vectors, or what a beam sees of them."""
    if data.beam is None:
        return VectorRows(knots, data.points, data.velocity, weight)
    along = (data.beam * data.velocity).sum(1)
    return DirectionRows(knots, data.points, data.beam, along, weight[:, 0])


def penalty_blocks(
    options: SplineOptions, knots: Knots, data: FitData, fit: list[RowBlock]
) -> tuple[list[RowBlock], torch.Tensor, float]:
    """Rows of all penalties in the density scaling, the cells they cover, and the damping's row factor."""
    components, extent = data.components, data.extent(knots)
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
        gram = options.curvature ** (2 * options.order) * smoothness_gram(options, knots, data)
        factor = row_factor(gram).to(data.points) / extent**0.5
        blocks.append(CellRows(knots, cells, factor, components))
    return blocks, cells, (options.damping or 0.0) * (prod(knots.spacing) / extent) ** 0.5


def smoothness_gram(options: SplineOptions, knots: Knots, data: FitData) -> np.ndarray:
    """(L, L) cell integral of |grad^m v|^2, plus (time_curvature / curvature)^2m |d^m v / dt^m|^2, m the order."""
    gram = curvature_gram(knots, range(data.components), options.order)
    if data.over_time and options.time_curvature:
        ratio = options.time_curvature / (options.curvature or 1.0)
        gram = gram + ratio ** (2 * options.order) * curvature_gram(knots, [data.components], options.order)
    return gram


def wall_roots(wall: WallRows) -> torch.Tensor:
    """(n,) row factors that turn sums over wall rows into means."""
    return (wall.weight / wall.weight.sum()).sqrt()


def _wall_blocks(
    knots: Knots, wall: WallRows, normal: float | None, no_slip: float | None, root: torch.Tensor
) -> list[RowBlock]:
    """Normal rows at every wall point, full-vector rows where the wall holds the blood."""
    blocks: list[RowBlock] = []
    if normal:
        target = (wall.normals * wall.velocity).sum(1)
        blocks.append(DirectionRows(knots, wall.points, wall.normals, target, normal * root))
    held = wall.no_slip
    if no_slip and bool(held.any()):
        blocks.append(VectorRows(knots, wall.points[held], wall.velocity[held], (no_slip * root[held])[:, None]))
    return blocks
