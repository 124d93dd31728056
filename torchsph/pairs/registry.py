"""Which backends this machine has, and the choice among them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .backends import cpu, reference, triton_backend
from .interface import Backend


@dataclass(frozen=True)
class RegisteredBackend:
    """A backend that can be asked for by name.

    Attributes:
        name: that of its instances.
        make: makes one.
        status: whether it can be used on a device, and why (not).
    """

    name: str
    make: Callable[[], Backend]
    status: Callable[[str], tuple[bool, str]]


# the best first; tests/torchsph/pairs/test_backends.py runs its battery on all of them
BACKENDS = (
    RegisteredBackend("cuda", triton_backend.CudaBackend, triton_backend.status),
    RegisteredBackend("cpu", cpu.CpuBackend, cpu.status),
    RegisteredBackend("reference", reference.ReferenceBackend, reference.status),
)


@dataclass(frozen=True)
class BackendStatus:
    """Whether a backend can be used here, and why (not)."""

    name: str
    present: bool
    reason: str


def available_backends(device: str = "cpu") -> list[BackendStatus]:
    """The known backends, best first, each with the reason why it can or cannot be used on ``device``."""
    return [BackendStatus(known.name, *known.status(device)) for known in BACKENDS]


def choose_backend(name: str = "auto", device: str = "cpu") -> Backend:
    """A pair backend by name.

    Args:
        name: "auto" for the best one that is present, or that of one of ``BACKENDS``.
        device: where the particles are.

    Raises:
        ValueError: the name is unknown, or the backend was asked for by name and is missing (the reason and
            the cure are in the message; nothing slower is taken silently in its place).
    """
    for known in BACKENDS:
        if name not in ("auto", known.name):
            continue
        present, reason = known.status(device)
        if present:
            return known.make()
        if name == known.name:
            raise ValueError(f"backend '{name}' was asked for and cannot be used: {reason}")
    raise ValueError(f"unknown backend '{name}'; known: auto, {', '.join(known.name for known in BACKENDS)}")
