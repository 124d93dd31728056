"""What callers hand over as rows, refused by its name before it is computed with."""

from collections.abc import Collection

import torch

from regularize.errors import InvalidInput


def check_real(name: str, values: torch.Tensor, shapes: Collection[tuple[int, ...]] | None = None) -> None:
    """Refuse anything but a dense tensor of real numbers, of one of the shapes where they are given.

    Args:
        name: what it is called.
        values: the tensor.
        shapes: that it may have; None: any.

    Raises:
        InvalidInput: it is something else.
    """
    if not isinstance(values, torch.Tensor):
        raise InvalidInput(f"{name} must be a tensor, not {type(values).__name__}")
    if not values.is_floating_point() or values.layout != torch.strided or values.device.type == "meta":
        kind = f"{values.layout} of {values.dtype} on '{values.device}'"
        raise InvalidInput(f"{name} must be a dense tensor of real numbers, not {kind}")
    if shapes is not None and tuple(values.shape) not in shapes:
        allowed = " or ".join(str(shape) for shape in shapes)
        raise InvalidInput(f"{name} has the shape {tuple(values.shape)}: it must be {allowed}")


def dense(name: str, values: torch.Tensor) -> torch.Tensor:
    """A dense tensor that holds real numbers, of whatever torch takes for one.

    Args:
        name: what it is called.
        values: a tensor, or what torch makes one of.

    Raises:
        InvalidInput: it is something else.
    """
    try:
        tensor = torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError) as fault:
        raise InvalidInput(f"{name} must be a tensor, not {type(values).__name__}") from fault
    if tensor.layout != torch.strided or tensor.device.type == "meta" or tensor.is_complex():
        kind = f"{tensor.layout} of {tensor.dtype} on '{tensor.device}'"
        raise InvalidInput(f"{name} must be a dense tensor of real numbers, not {kind}")
    return tensor
