"""What arrays must be before their addresses go to compiled code, which reads and writes wherever it is told."""

from __future__ import annotations

import torch

from regularize.errors import InvalidInput
from regularize.rows.operators import System
from regularize.rows.ordering import Ordering

# sizes of the arrays on the stack in csrc/spline.cpp
MOST_COMPONENTS, MOST_AXES = 3, 4
INT32 = 2**31 - 1


def fits(system: System) -> bool:
    """Whether the compiled assembly has room for the components and axes of a system."""
    return system.components <= min(MOST_COMPONENTS, system.knots.axes) and system.knots.axes <= MOST_AXES


def check_array(name: str, array: torch.Tensor, dtype: torch.dtype, shape: tuple[int, ...]) -> None:
    """Refuse an array that compiled code would misread.

    Args:
        name: what it is called.
        array: an array.
        dtype: its type.
        shape: its shape, -1 for any length.

    Raises:
        InvalidInput: it has another type or shape, is not on the CPU, or not contiguous.
    """
    if array.device.type != "cpu":
        raise InvalidInput(f"{name} is on the device '{array.device}'; compiled code reads the CPU's memory alone")
    if array.dtype != dtype:
        raise InvalidInput(f"{name} is of {array.dtype}: it must be of {dtype}")
    if array.ndim != len(shape) or any(w not in (-1, n) for w, n in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("any" if length < 0 else str(length) for length in shape)
        raise InvalidInput(f"{name} has the shape {tuple(array.shape)}: it must be ({wanted})")
    if not array.is_contiguous():
        raise InvalidInput(f"{name} is not contiguous; hand over .contiguous()")


def check_band(band: torch.Tensor, reach: torch.Tensor) -> None:
    """Refuse a band that its columns do not fit into.

    Args:
        band: (n, width), float64 or float32.
        reach: (n,) int64, rising: the last row of each column.

    Raises:
        InvalidInput: another type, shape or device, or columns that reach beyond the band or the matrix.
    """
    single = band.dtype == torch.float32
    check_array("the band", band, torch.float32 if single else torch.float64, (-1, -1))
    count, width = band.shape
    check_array("reach", reach, torch.int64, (count,))
    if count == 0 or width == 0:
        raise InvalidInput(f"the band has the shape {tuple(band.shape)}: there is no matrix in it")
    own = torch.arange(count)
    longest, last = int((reach - own).max()) + 1, int(reach.max())
    if bool((reach < own).any()) or bool((reach.diff() < 0).any()) or last >= count:
        raise InvalidInput(f"reach must rise, from each column's own number on, and stay below {count} rows")
    if longest > width:
        raise InvalidInput(
            f"the band is {width} wide, but its columns reach {longest} rows: it was cut, or is of another ordering"
        )


def check_slots(ordering: Ordering, cell: torch.Tensor) -> torch.Tensor:
    """Places (n,) of cells (n, A) among those of an ordering, contiguous.

    Raises:
        InvalidInput: a cell is none of them: the rows belong to another ordering.
    """
    key = ordering.key(cell)
    if key.numel():
        least, most = (int(value) for value in torch.aminmax(key))
        if least < 0 or most >= len(ordering.places):
            raise InvalidInput("rows lie in cells that the ordering's knots do not have")
    slot = ordering.places[key].contiguous()
    held = slot.clamp(0, len(ordering.keys) - 1)
    if not bool((ordering.keys[held] == key).all()):
        raise InvalidInput("rows lie in cells that the ordering does not hold; order the system that they belong to")
    return slot


def check_sizes(system: System, ordering: Ordering) -> None:
    """Refuse a system that compiled code cannot number, or has no room for.

    Raises:
        InvalidInput: too many components, axes or coefficients, or rows that are not on the CPU.
    """
    if not fits(system):
        raise InvalidInput(
            f"compiled code takes up to {MOST_COMPONENTS} components, no more than axes, of which {MOST_AXES} at most; "
            f"this system has {system.components} and {system.knots.axes}: use the engine 'reference'"
        )
    if len(ordering.nodes) * system.components > INT32:
        raise InvalidInput(
            f"{len(ordering.nodes)} coefficients of {system.components} components are more than an int32 can number: "
            "use wider knots, or fewer frames at once"
        )
    if ordering.nodes.device.type != "cpu":
        raise InvalidInput(f"the ordering is on '{ordering.nodes.device}'; compiled code works on the CPU alone")
