"""A device that is none: tensors say that they are on it, numbers are the processor's, and transfers are counted.

Code that is meant for a GPU runs whole on a machine without one: what mixes devices raises, as it would there, and what
makes the processor wait for the GPU is recorded with the line that asked for it.
"""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from unittest import mock

import pytest
import torch
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_flatten, tree_map, tree_unflatten

import torchsph
from torchsph.pairs import choose_backend
from torchsph.pairs.backends.triton_backend import CudaBackend

NAME = "pretended"
# the folder that holds the packages under test: the checkout, or where a wheel was installed
HOME = str(Path(torchsph.__file__).parents[1])
# operations whose result the processor needs before it can go on: numbers, or the shape of what comes out
WAITING = {
    "_local_scalar_dense": "item",
    "nonzero": "nonzero",
    "masked_select": "mask",
    "_unique2": "unique",
    "unique_dim": "unique",
    "unique_consecutive": "unique",
    "bincount": "bincount",
    "equal": "equal",
    "is_nonzero": "item",
    "_linalg_check_errors": "linalg",
}
# operations that take tensors of both devices
BETWEEN = ("_to_copy", "copy_", "index", "index_put_", "index_put", "_index_put_impl_", "set_")


class Pretend(torch.Tensor):
    """A tensor that says it is on the GPU; ``held`` is where its numbers are."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> Pretend:
        held = held.resolve_conj().resolve_neg()  # which the tensor around it would not know of
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=torch.device(NAME, 0),
        )
        made.held = held
        return made

    def tolist(self) -> object:
        """Numbers, as any tensor gives them; torch itself refuses subclasses."""
        return self.cpu().tolist()

    def __repr__(self, **_: object) -> str:
        return f"Pretend({self.held!r})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        raise RuntimeError(f"{func} on a pretended device that is not at work any more")


class PretendedDevice(TorchDispatchMode):
    """While it is at work, tensors are made on ``NAME`` and moved there.

    Attributes:
        waits: how often the processor had to wait for the device, by (kind, "file:line" of our packages).
        uploads: how often it sent something, likewise.
    """

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter = Counter()
        self.uploads: Counter = Counter()
        self.calls = 0

    def forget(self) -> None:
        """Count anew."""
        self.waits.clear()
        self.uploads.clear()
        self.calls = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        name = func._schema.name.removeprefix("aten::")
        flat, spec = tree_flatten((args, kwargs))
        tensors = [value for value in flat if isinstance(value, torch.Tensor)]
        ours = [value for value in tensors if isinstance(value, Pretend)]
        target = kwargs.get("device")
        on_device = bool(ours) if target is None else torch.device(target).type == NAME
        if ours:
            self._check(name, tensors)
            self.calls += 1
        self._note(func, name, args, kwargs, ours, on_device)
        if target is not None and torch.device(target).type == NAME:
            kwargs["device"] = torch.device("cpu")
            if name == "_to_copy" and not ours:
                kwargs["memory_format"] = kwargs.get("memory_format") or torch.preserve_format
            flat, spec = tree_flatten((args, kwargs))
        homes = {id(value.held): value for value in ours}
        args, kwargs = tree_unflatten([v.held if isinstance(v, Pretend) else v for v in flat], spec)
        result = func(*args, **kwargs)
        if not on_device and name != "copy_":
            return result
        if name == "copy_" and not isinstance(flat[0], Pretend):
            return result
        return tree_map(lambda v: homes[id(v)] if id(v) in homes else Pretend(v) if _plain(v) else v, result)

    def _check(self, name: str, tensors: list[torch.Tensor]) -> None:
        """Refuse what torch refuses: tensors of both devices, but for single numbers."""
        strangers = [value for value in tensors if not isinstance(value, Pretend) and value.ndim > 0]
        if strangers and name not in BETWEEN:
            raise RuntimeError(
                f"Expected all tensors to be on the same device, but aten::{name} got {strangers[0].shape} on the "
                f"processor beside tensors on the device, in {place()}"
            )

    def _note(self, func, name: str, args, kwargs, ours: list, on_device: bool) -> None:
        kind = None
        if ours and name in WAITING:
            kind = WAITING[name]
        elif ours and name in ("index", "index_put_", "index_put", "_index_put_impl_"):
            if any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in args[1]):
                kind = "mask"
        elif ours and name == "repeat_interleave" and kwargs.get("output_size") is None:
            kind = "repeat_interleave"
        elif ours and name in ("_to_copy", "copy_") and (not on_device or not isinstance(args[0], Pretend)):
            kind = "download"
        if kind is not None:
            self.waits[kind, place()] += 1
        sent = name == "_to_copy" and on_device and not isinstance(args[0], Pretend)
        if sent or (name == "copy_" and isinstance(args[0], Pretend) and not isinstance(args[1], Pretend)):
            self.uploads["upload", place()] += 1


def _plain(value: object) -> bool:
    return isinstance(value, torch.Tensor) and not isinstance(value, Pretend)


def place() -> str:
    """The innermost line of our packages on the way here."""
    frame = sys._getframe(1)
    packages = tuple(f"{HOME}/{package}/" for package in ("torchsph", "regularize", "geometry"))
    while frame is not None:
        if frame.f_code.co_filename.startswith(packages):
            return f"{frame.f_code.co_filename.removeprefix(HOME)[1:]}:{frame.f_lineno} {frame.f_code.co_name}"
        frame = frame.f_back
    return "outside our packages"


class OfProcessor(torch.Generator):
    """A generator of the processor, whatever device it is asked for."""

    def __new__(cls, device: object = "cpu") -> OfProcessor:
        return super().__new__(cls, "cpu")


@contextlib.contextmanager
def pretended_device() -> Iterator[PretendedDevice]:
    """A device to ask for by ``NAME``."""
    _register()
    taken = mock.patch("torchsph.simulator.simulator.usable_device", str)
    with taken, mock.patch("torch.Generator", OfProcessor), PretendedDevice() as device:
        before = torch._C._only_lift_cpu_tensors()
        torch._C._set_only_lift_cpu_tensors(True)  # `torch.tensor(..., device=NAME)` asks for a driver otherwise
        try:
            yield device
        finally:
            torch._C._set_only_lift_cpu_tensors(before)


@lru_cache
def _register() -> None:
    """Tell torch the device's name, once in a process."""
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip("this torch takes no devices that are made in Python")
    backend_registration._setup_privateuseone_for_python_backend(NAME)


class PretendedCuda(CudaBackend):
    """The Triton backend on the pretended device: all of it but the kernels, whose sums the compiled passes give."""

    def __init__(self) -> None:
        self._kernels = _Kernels()
        self.device, self._block, self._sent = NAME, 64, {}
        self.cpu = choose_backend("cpu")
        self._lists: dict[int, object] = {}

    def search(self, position, member, radius, *, margin=0.0, period=None):
        """See ``Backend.search``."""
        runs = super().search(position, member, radius, margin=margin, period=period)
        with _disable_current_modes():
            far = None if period is None else period.held
            listed = self.cpu.search(position.held, member.held, radius, margin=margin, period=far)
        self._lists = {id(runs): (runs, listed)}
        return runs

    def _evaluate(self, pairs, state, support, request, field=None, active=None):
        outputs = super()._evaluate(pairs, state, support, request, field, active)
        with _disable_current_modes():
            listed = self._lists[id(pairs)][1]
            held = tree_map(lambda value: value.held if isinstance(value, Pretend) else value, vars(state))
            given = [None if value is None else value.held for value in (field, active)]
            momentum = request.momentum and replace(
                request.momentum,
                **{name: value.held for name, value in vars(request.momentum).items() if isinstance(value, Pretend)},
            )
            sums = self.cpu._evaluate(listed, type(state)(**held), support, replace(request, momentum=momentum), *given)
            for output, total in zip(outputs, sums, strict=True):
                output.held.copy_(total)
        return outputs


class _Kernels:
    """In the place of the Triton kernels: takes the same arguments and leaves zeros."""

    def __init__(self) -> None:
        self.pair_sums = self

    def __getitem__(self, grid: tuple[int]):
        return lambda packed, stress, raw, *_, **__: raw.zero_()
