"""Cores that this process may use: not those of the machine, where a scheduler or a container allows fewer."""

from __future__ import annotations

import math
import os
from pathlib import Path

from .control_groups import OWN, ROOT, control_groups


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


def _quota(root: Path = ROOT, own: Path = OWN) -> float | None:
    """Cores' worth of time that the tightest group around this process may take (cgroup v2, or v1's cpu controller)."""
    shares = [
        _share(folder, ("cpu.max",) if second else ("cpu.cfs_quota_us", "cpu.cfs_period_us"))
        for folder, second in control_groups("cpu", root, own)
    ]
    return min((share for share in shares if share is not None), default=None)


def _share(folder: Path, names: tuple[str, ...]) -> float | None:
    """Time over period of one group; None where it has no limit."""
    try:
        quota, period = " ".join((folder / name).read_text(encoding="ascii") for name in names).split()
        return float(quota) / float(period) if float(quota) > 0 else None
    except (OSError, ValueError, ZeroDivisionError):  # no such group here, or "max"
        return None
