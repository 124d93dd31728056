"""What a run must be told before it may start or go on: times, devices and particles, each refused by its name."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from geometry.arguments import between
from torchsph.pairs.backends.checks import expect

from .particles import CHANNEL, RESERVOIR, Particles

# each holds all particles: more fit into no machine
MOST_MEMBERS = 2**16
SPACING = between(1e-6, 1.0)  # m, of particles in a recording; less and more are mistakes of units
MOST_RATIO = 1e6  # of the heaviest particle's mass to the lightest one's


def check_time(time: float, name: str) -> float:
    """A finite time.

    Args:
        time: s.
        name: what it is called.

    Raises:
        TypeError: it is no number.
        ValueError: it is not finite.
    """
    try:
        value = math.nan if isinstance(time, str) else float(time)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{name} must be one number (s), got {type(time).__name__}") from None
    if not math.isfinite(value):
        raise ValueError(f"{name} must be finite (s), got {value}")
    return value


def check_seed(seed: int) -> int:
    """A whole number that torch's generators take.

    Raises:
        ValueError: it is none.
    """
    if not _is_whole(seed) or not -(2**63) <= seed < 2**64:
        raise ValueError(f"seed must be a whole number of at most 64 bits, got {seed!r}")
    return int(seed)


def check_count(count: int, name: str, most: int = MOST_MEMBERS) -> int:
    """A whole number of things, at least one.

    Args:
        count: as given.
        name: what is counted, which opens the message.
        most: of them.

    Raises:
        ValueError: it is none.
    """
    if not _is_whole(count) or not 1 <= count <= most:
        raise ValueError(f"{name}, a whole number of them up to {most}, got {count!r}")
    return int(count)


def _is_whole(value: object) -> bool:
    return isinstance(value, int | float | np.number) and math.isfinite(value) and int(value) == value


def usable_device(name: str | torch.device) -> str:
    """The name of a device that this machine has.

    Args:
        name: "cpu", "cuda" or "cuda:N".

    Raises:
        ValueError: torch knows no such device, simulations do not run on it, or this machine has none of it.
    """
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        raise ValueError(f"unknown device '{name}'; use cpu, cuda or cuda:N") from None
    if device.type not in ("cpu", "cuda") or (device.type == "cpu" and device.index):
        raise ValueError(f"device '{name}' is not supported; use cpu, cuda or cuda:N")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ValueError(f"this machine has no '{name}' that torch {torch.__version__} can use; use cpu")
    return str(device)


def check_arrays(particles: Particles, dimension: int, dtype: torch.dtype, device: str) -> None:
    """Refuse particles whose arrays disagree with each other or with the run; looks at no values, so costs nothing.

    Args:
        particles: the particles.
        dimension: 2 or 3.
        dtype: of what is no whole number.
        device: where the run is.

    Raises:
        TypeError: an array is no tensor, or of another type than the run's.
        ValueError: an array has another length, dimension or device.
    """
    count = len(particles.position) if isinstance(particles.position, Tensor) and particles.position.ndim else 0
    whole = {"member": (count,), "kind": (count,), "label": (count,)}
    shapes = dict.fromkeys(("position", "velocity", "origin"), (count, dimension))
    kind = torch.device(device).type
    needed = dict.fromkeys(("position", "velocity", "deviation", "mass", "member", "kind"))
    for name, array in (needed | particles.arrays()).items():
        if not isinstance(array, Tensor):
            raise TypeError(f"the particles' {name} must be a tensor, got {type(array).__name__}")
        expect(f"the particles' {name}", array, shapes.get(name, (count,)), torch.int64 if name in whole else dtype)
        if array.device.type != kind:
            raise ValueError(f"the particles' {name} is on '{array.device}', the simulator on '{device}'")


def check_members(particles: Particles) -> None:
    """Refuse particles of members that there are not.

    Raises:
        ValueError: there is no member, or a particle's is none of them.
    """
    if particles.members < 1:
        raise ValueError(f"a simulation needs at least one member, got {particles.members}")
    if particles.count:
        least, most = (int(value) for value in torch.aminmax(particles.member))
        if least < 0 or most >= particles.members:
            known = f"there are {particles.members}: 0 to {particles.members - 1}"
            raise ValueError(f"the particles' member runs from {least} to {most}, but {known}")


def check_values(particles: Particles, openings: int = 0) -> None:
    """Refuse particles that no run can step.

    A member with numbers that are not finite is one that has failed, and may be among others that have not.

    Args:
        particles: the particles.
        openings: of the scene, with buffers behind them.

    Raises:
        ValueError: member numbers beyond the members, kinds beyond the openings, masses that are not positive,
            densities that are not, no finite member at all.
    """
    p = particles
    check_members(p)
    if not p.count:
        return
    least, most = (int(value) for value in torch.aminmax(p.kind))
    if least < CHANNEL - openings + 1 or most > RESERVOIR + openings - 1:
        raise ValueError(
            f"the particles' kind runs from {least} to {most}, but the scene has {openings} openings with buffers: "
            f"{CHANNEL - openings + 1} to {RESERVOIR + openings - 1} is what there can be"
        )
    if bool((p.mass <= 0).any()):
        raise ValueError(f"the particles' mass must be positive, but is {float(p.mass.min()):g} at the least")
    lightest, heaviest = (float(value) for value in torch.aminmax(p.mass))
    if heaviest > MOST_RATIO * lightest:
        raise ValueError(f"the particles' mass runs from {lightest:g} to {heaviest:g}: those of one run are alike")
    if bool((p.deviation <= -1).any()):
        raise ValueError(
            "the particles' deviation, (rho - rho0) / rho0, must be above -1 (no density at all), but is "
            f"{float(p.deviation.min()):g} at the least"
        )
    if p.confidence is not None and not bool((torch.isfinite(p.confidence) & (p.confidence >= 0)).all()):
        raise ValueError("the particles' confidence must be finite and not negative")
    rows = torch.cat([p.position, p.velocity, p.deviation[:, None], p.mass[:, None]], 1)
    broken = p.per_member((~torch.isfinite(rows).all(1)).to(torch.int64), "sum") > 0
    if bool(broken.all()):
        raise ValueError("the particles hold values that are not finite in every member; start from finite ones")
