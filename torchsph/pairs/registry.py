"""Which backends this machine has, and the choice among them."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchsph.native.library import LibraryMissing, library

from .backends import triton_backend as cuda
from .backends.cpu import CpuBackend
from .backends.reference import ReferenceBackend
from .interface import Backend


@dataclass(frozen=True)
class BackendStatus:
    """Whether a backend can be used here, and why (not)."""

    name: str
    present: bool
    reason: str


def available_backends(device: str = "cpu") -> list[BackendStatus]:
    """The known backends, best first, each with the reason why it can or cannot be used on ``device``."""
    reference = BackendStatus("reference", True, "plain torch, any device, always present")
    return [BackendStatus("cuda", *cuda.status(device)), _cpu_status(device), reference]


def _cpu_status(device: str) -> BackendStatus:
    if torch.device(device).type != "cpu":
        return BackendStatus("cpu", False, f"works on CPU tensors only, the device asked for is '{device}'")
    try:
        compiled = library()
    except LibraryMissing as problem:
        return BackendStatus("cpu", False, str(problem))
    return BackendStatus("cpu", True, f"compiled C++ on {compiled.instruction_set} instructions")


def backend(name: str = "auto", device: str = "cpu") -> Backend:
    """The backend called ``name``, or the best one that is present for "auto".

    Raises:
        ValueError: the name is unknown, or the backend was asked for by name and is missing (the reason and
            the cure are in the message; nothing slower is taken silently in its place).
    """
    known = available_backends(device)
    if name == "auto":
        return _make(next(status.name for status in known if status.present))
    for status in known:
        if status.name == name:
            if not status.present:
                raise ValueError(f"backend '{name}' was asked for and cannot be used: {status.reason}")
            return _make(name)
    raise ValueError(f"unknown backend '{name}'; known: auto, {', '.join(status.name for status in known)}")


def _make(name: str) -> Backend:
    return {"cuda": cuda.CudaBackend, "cpu": CpuBackend, "reference": ReferenceBackend}[name]()
