"""What is handed to a run on a grid, held against the grid and the run where it enters."""

from __future__ import annotations

import torch
from torch import Tensor

from geometry import Grid
from torchsph.pairs.backends.checks import expect


def check_grid(grid: Grid, dimension: int) -> None:
    """Refuse a plane grid in space, and the other way round.

    Args:
        grid: the nodes.
        dimension: of the run.

    Raises:
        TypeError: it is no grid.
        ValueError: they differ.
    """
    if not isinstance(grid, Grid):
        raise TypeError(f"grid must be a geometry.Grid, got {type(grid).__name__}")
    if grid.dimension != dimension:
        raise ValueError(
            f"a grid of {grid.dimension} dimensions, {grid.shape}, was given to a simulation of {dimension}; use the "
            "recording that the scene was made from, or make the scene from this one"
        )


def check_mask(mask: Tensor, grid: Grid) -> None:
    """Refuse anything but a bool for each node.

    Raises:
        TypeError: it is no tensor, or not of bools.
        ValueError: its shape is not the grid's.
    """
    _check_tensor("mask", mask)
    expect("mask", mask, grid.shape, torch.bool)


def check_velocity(name: str, velocity: Tensor, grid: Grid, mask: Tensor, batches: tuple[int, ...] = ()) -> None:
    """Refuse a field of velocities that is not of the grid, or not finite where it is known.

    Args:
        name: what it is called.
        velocity: (D, *shape) or, with a leading axis of one of the `batches`, (members, D, *shape), m/s.
        grid: the nodes.
        mask: (*shape) bool, where it is known.
        batches: lengths that a leading axis may have.

    Raises:
        TypeError: it is no tensor of real numbers.
        ValueError: another shape, or values that are not finite.
    """
    _check_real(name, velocity)
    shape = (grid.dimension, *grid.shape)
    allowed = dict.fromkeys((shape, *((batch, *shape) for batch in batches)))
    if tuple(velocity.shape) not in allowed:
        wanted = " or ".join(map(str, allowed))
        raise ValueError(f"{name} must have the shape {wanted}, got {tuple(velocity.shape)}")
    bad = (~torch.isfinite(velocity)).reshape(-1, *shape).any(0).any(0) & mask.to(velocity.device)
    if bool(bad.any()):
        raise ValueError(
            f"{name} is not finite at {int(bad.sum())} nodes where it is said to be known, as at "
            f"{_first(bad)} (array order); take them out of the mask"
        )


def check_weight(name: str, weight: Tensor, grid: Grid, most: float | None = None) -> None:
    """Refuse weights that are not one finite, not negative number for each node.

    Args:
        name: what they are called.
        weight: (*shape).
        grid: the nodes.
        most: largest value that is allowed; None: any.

    Raises:
        TypeError: they are no tensor of real numbers.
        ValueError: another shape, or values that cannot be.
    """
    _check_real(name, weight)
    expect(name, weight, grid.shape)
    fine = torch.isfinite(weight) & (weight >= 0)
    if most is not None:
        fine &= weight <= most
    if not bool(fine.all()):
        rule = "finite and not negative" if most is None else f"from 0 to {most:g}"
        node = _first(~fine)
        raise ValueError(f"{name} must be {rule}, but is {float(weight[node]):g} at {node} (array order)")


def check_some(name: str, weight: Tensor, cure: str, mask: Tensor | None = None) -> None:
    """Refuse weights that are 0 wherever they count, with which nothing would be done.

    Args:
        name: what they are called.
        weight: (*shape), not negative.
        cure: what to do instead.
        mask: (*shape) bool, where they count; None: everywhere.

    Raises:
        ValueError: none is positive.
    """
    if not bool((weight > 0).any() if mask is None else ((weight > 0) & mask.to(weight.device)).any()):
        where = "at every node" if mask is None else "at every node of the mask"
        raise ValueError(f"{name} is 0 {where}, so nothing is known anywhere; {cure}")


def _check_real(name: str, array: Tensor) -> None:
    _check_tensor(name, array)
    if not array.is_floating_point():
        raise TypeError(f"{name} must hold floating-point numbers, got {array.dtype}")


def _check_tensor(name: str, array: Tensor) -> None:
    if not isinstance(array, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(array).__name__}")
    if array.device.type == "meta":
        raise ValueError(f"{name} is on the device 'meta', where tensors hold no numbers")
    if array.layout != torch.strided:
        raise TypeError(f"{name} must be a dense tensor, got one of layout {array.layout}; use to_dense()")


def _first(bad: Tensor) -> tuple[int, ...]:
    return tuple(int(number) for number in torch.nonzero(bad)[0])
