"""The control groups of Linux around this process, by which a scheduler or a container limits what it may take."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

ROOT, OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def control_groups(controller: str, root: Path = ROOT, own: Path = OWN) -> Iterator[tuple[Path, bool]]:
    """Folders of the groups that may limit ("cpu", "memory"), from inside out; and whether they are of version 2.

    Args:
        controller: what they limit.
        root: where the groups are mounted.
        own: file that names the groups of a process; nothing where there is none.
    """
    try:
        entries = [line.split(":", 2) for line in own.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return
    for _, controllers, path in entries:
        second = controllers == ""
        if not second and controller not in controllers.split(","):
            continue
        base = root if second else root / controller
        group = base / path.lstrip("/")
        for folder in (group, *group.parents):
            yield folder, second
            if folder == base:
                break
