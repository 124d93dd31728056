"""The sums of speckle tracking by compiled code (``csrc/correlation.cpp``, ``csrc/images.cpp``), on the CPU."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import torch
from torch import Tensor

from torchsph.native.library import REALS, library
from torchsph.native.structures import BoxArguments, CorrelationArguments, ImageArguments

from .correlation import KernelShape, Triple, check_apart, triple

_STRUCTURES = {"correlate": CorrelationArguments, "arrange": ImageArguments, "box_sums": BoxArguments}
_Triple = ctypes.c_int64 * 3


def _call(name: str, dtype: torch.dtype, **arguments: object) -> None:
    """Call ``name``; tensors are passed by their addresses, tuples as triples."""
    plain = {
        key: value.data_ptr() if isinstance(value, Tensor) else _Triple(*value) if isinstance(value, tuple) else value
        for key, value in arguments.items()
    }
    function = library().function(name, REALS[dtype])
    function.restype = None
    function(ctypes.byref(_STRUCTURES[name](threads=torch.get_num_threads(), **plain)))


class CompiledTracking:
    """The sums by compiled code, see :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`.

    As many threads as torch uses; their number changes nothing in the results.
    """

    name = "cpu"

    def mean_power(self, images: Tensor) -> Tensor:
        """See :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`."""
        images = images.resolve_conj().contiguous()
        power = images.real.new_empty(images.shape[1:])
        _call(
            "arrange",
            power.dtype,
            images=len(images),
            shape=tuple(images.shape[1:]),
            margin=(0, 0, 0),
            samples=images,
            volume=None,
            power=power,
            turn=None,
        )
        return power

    def arrange(self, images: Tensor, margin: Triple, *, turns: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """See :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`."""
        images, shape = images.resolve_conj().contiguous(), tuple(images.shape[1:])
        whole = tuple(n + 2 * m for n, m in zip(shape, margin, strict=True))
        volume, power = images.new_empty((*whole, len(images))), images.real.new_empty(whole)
        turn = images.new_empty(whole) if turns else None
        _call(
            "arrange",
            power.dtype,
            images=len(images),
            shape=shape,
            margin=margin,
            samples=images,
            volume=volume,
            power=power,
            turn=turn,
        )
        return volume, power, turn

    def box_sums(self, field: Tensor, middle: Tensor, half: Triple) -> Tensor:
        """See :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`."""
        return _box_sums(field.contiguous(), _nodes(middle, field.shape, half), half)

    def sums_around(self, field: Tensor, half: Triple) -> Callable[[Tensor], Tensor]:
        """See :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`."""
        return lambda middle: _box_sums(field, _nodes(middle, field.shape), half)

    def correlate(
        self,
        volume: Tensor,
        apart: int,
        corner: Tensor,
        offset: Tensor,
        shape: KernelShape,
        *,
        ramp: Tensor | None = None,
    ) -> Tensor:
        """See :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`."""
        images, half = volume.shape[-1], corner.new_tensor(shape.half)
        check_apart(apart, images)
        reach = triple(h + s for h, s in zip(shape.half, shape.search, strict=True))
        corner, offset = corner.contiguous(), offset.contiguous()
        _nodes(corner + half, volume.shape, shape.half)
        _nodes(corner + half + offset, volume.shape, reach)
        rho = volume.new_empty((len(corner), *shape.lags))
        _call(
            "correlate",
            rho.real.dtype,
            points=len(corner),
            images=images,
            apart=apart,
            shape=tuple(volume.shape[:3]),
            half=shape.half,
            search=shape.search,
            volume=volume.contiguous(),
            corner=corner,
            offset=offset,
            ramp=None if ramp is None else ramp.contiguous(),
            rho=rho,
        )
        return rho


def _box_sums(field: Tensor, nodes: Tensor, half: Triple) -> Tensor:
    """Sums (P,) over the parts inside the volume of the boxes around ``nodes`` (P, 3)."""
    sums = field.new_empty(len(nodes))
    _call(
        "box_sums",
        field.dtype.to_real(),
        points=len(nodes),
        parts=1 + field.is_complex(),
        shape=tuple(field.shape),
        reach=half,
        field=field,
        middle=nodes,
        out=sums,
    )
    return sums


def _nodes(middle: Tensor, shape: torch.Size, reach: Triple = (0, 0, 0)) -> Tensor:
    """``middle`` (P, 3), contiguous; IndexError where a box of ``reach`` around one leaves the volume."""
    if len(middle):
        lowest, highest = middle.amin(0).tolist(), middle.amax(0).tolist()
        for low, high, nodes, r in zip(lowest, highest, shape, reach, strict=False):
            if low < r or high + r >= nodes:
                raise IndexError(f"boxes from node {low - r} to {high + r} in a volume of {nodes} nodes on an axis")
    return middle.contiguous()
