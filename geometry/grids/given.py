"""What callers hand over in place of numbers and tensors, refused by its name."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor


def numbers(name: str, values: Iterable[float]) -> tuple[float, ...]:
    """Several finite numbers.

    Args:
        name: what they are, which opens the message.
        values: as given.

    Raises:
        ValueError: they are something else.
    """
    try:
        found = tuple(float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be numbers, not {values!r:.80}") from None
    if not all(math.isfinite(value) for value in found):
        raise ValueError(f"{name} must be finite, not {found}")
    return found


def whole_numbers(name: str, values: Iterable[int]) -> tuple[int, ...]:
    """Several whole numbers.

    Raises:
        ValueError: they are something else.
    """
    found = numbers(name, values)
    if any(value != int(value) for value in found):
        raise ValueError(f"{name} must be whole numbers, not {found}")
    return tuple(int(value) for value in found)


def check_floats(name: str, values: Tensor) -> None:
    """Refuse anything but a dense tensor of real floating-point numbers.

    Raises:
        TypeError: it is no tensor.
        ValueError: it holds something else, or nothing at all (sparse, or on the device "meta").
    """
    if not isinstance(values, Tensor):
        raise TypeError(f"{name} must be a tensor, not {type(values).__name__}")
    if not values.is_floating_point():
        raise ValueError(f"{name} must be floating point, not {values.dtype}")
    if values.is_sparse or values.device.type == "meta":
        raise ValueError(f"{name} must be a dense tensor that holds numbers, not {values.layout} on {values.device}")


def device_of(name: str, device: torch.device | str) -> torch.device:
    """A device that holds numbers.

    Args:
        name: what it is, which opens the message.
        device: as given.

    Raises:
        ValueError: torch knows no such device, or it is "meta".
    """
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError):
        raise ValueError(f"{name} must be a device of torch, as cpu or cuda:0, not {device!r:.60}") from None
    if found.type == "meta":
        raise ValueError(f"{name} must hold numbers, which 'meta' does not")
    return found
