"""Cores that this process may use: not those of the machine, where a scheduler or a container allows fewer."""

from __future__ import annotations

import math
import os
from pathlib import Path


def usable_cores() -> int:
    """How many, at least 1.

    The least of what the system lets this process run on, of the time that its control groups may take, and of
    ``OMP_NUM_THREADS``, by which a caller says how much of the machine is meant for it.
    """
    most = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limits = [most, _quota(), _asked(os.environ.get("OMP_NUM_THREADS", ""))]
    return max(1, math.floor(min(limit for limit in limits if limit is not None)))


def _asked(threads: str) -> int | None:
    """The number in ``OMP_NUM_THREADS``; of a list for nested regions the first."""
    first = threads.split(",")[0].strip()
    return int(first) if first.isdigit() and int(first) > 0 else None


def _quota(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> float | None:
    """Cores' worth of time that the tightest group around this process may take (cgroup v2, or v1's cpu controller)."""
    try:
        entries = [line.split(":", 2) for line in own.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return None
    found: list[float] = []
    names: tuple[str, ...]
    for _, controllers, path in entries:
        if controllers == "":
            base, names = root, ("cpu.max",)
        elif "cpu" in controllers.split(","):
            base, names = root / "cpu", ("cpu.cfs_quota_us", "cpu.cfs_period_us")
        else:
            continue
        group = base / path.lstrip("/")
        for folder in (group, *group.parents):
            share = _share(folder, names)
            found += [] if share is None else [share]
            if folder == base:
                break
    return min(found, default=None)


def _share(folder: Path, names: tuple[str, ...]) -> float | None:
    """Time over period of one group; None where it has no limit."""
    try:
        quota, period = " ".join((folder / name).read_text(encoding="ascii") for name in names).split()
        return float(quota) / float(period) if float(quota) > 0 else None
    except (OSError, ValueError, ZeroDivisionError):  # no such group here, or "max"
        return None
