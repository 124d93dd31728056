"""From checked samples and options to the row blocks of the system."""

from math import prod

import numpy as np
import torch

from regularize.basis.knots import Knots
from regularize.errors import InvalidInput
from regularize.options import SplineOptions, length_of
from regularize.rows.operators import CellRows, DirectionRows, DivergenceRows, RowBlock, System, VectorRows
from regularize.rows.penalties import curvature_gram, divergence_gram, row_factor
from regularize.rows.walls import WallRows

from .samples import FitData


def build_system(options: SplineOptions, knots: Knots, data: FitData) -> System:
    """The rows of Grønli 2017, eq. 3.22 (plus no-slip and curvature) with the options' scaling."""
    return _thesis_system(options, knots, data) if options.scaling == "thesis" else _density(options, knots, data)


def _thesis_system(options: SplineOptions, knots: Knots, data: FitData) -> System:
    components = data.components
    blocks: list[RowBlock] = [sample_rows(knots, data, data.weight[:, None])]
    divergence = length_of(options.divergence)
    if divergence:
        where = data.points if data.divergence_points is None else data.divergence_points
        per_spacing = divergence * sum(knots.spacing[:components]) / components
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
    divergence, curvature = length_of(options.divergence), length_of(options.curvature)
    blocks: list[RowBlock] = []
    if data.wall is not None and float(data.wall.weight.sum()) > 0:
        blocks += _wall_blocks(knots, data.wall, options.wall, options.no_slip, wall_roots(data.wall))
    where = data.divergence_points
    if where is not None and len(where) and divergence:
        each = torch.full_like(where[:, 0], divergence / len(where) ** 0.5)
        blocks.append(DivergenceRows(knots, where, components, each))
    cells = torch.unique(torch.cat([knots.cell_number(block.cell) for block in [*fit, *blocks]]))
    cells = knots.cell_index(cells)
    if where is None and divergence:
        factor = row_factor(divergence_gram(knots, components), components).to(data.points)
        blocks.append(CellRows(knots, cells, divergence / extent**0.5 * factor, components))
    if curvature:
        gram = curvature ** (2 * options.order) * smoothness_gram(options, knots, data)
        factor = row_factor(gram).to(data.points) / extent**0.5
        blocks.append(CellRows(knots, cells, factor, components))
    return blocks, cells, (options.damping or 0.0) * (prod(knots.spacing) / extent) ** 0.5


def smoothness_gram(options: SplineOptions, knots: Knots, data: FitData) -> np.ndarray:
    """(L, L) cell integral of |grad^m v|^2, plus (time_curvature / curvature)^2m |d^m v / dt^m|^2, m the order."""
    gram = curvature_gram(knots, range(data.components), options.order)
    if data.over_time and length_of(options.time_curvature):
        ratio = length_of(options.time_curvature) / (length_of(options.curvature) or 1.0)
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
