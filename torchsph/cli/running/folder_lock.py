"""One run at a time in a folder of results."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

NAME = ".torchsph.lock"


@contextmanager
def locked(folder: str | Path) -> Iterator[Path]:
    """The folder, made where it is not there, and held against other runs for as long as the block runs.

    The lock file names host, process and start. The kernel holds the lock for the process, so that of a run that was
    killed is taken over at once. Of a run on another machine nobody here can know whether it lives: its lock stands
    until somebody removes it. A folder that was made for the run and stays empty vanishes again.

    Raises:
        ValueError: another run is at work in the folder.
    """
    folder = Path(folder)
    made = not folder.is_dir()
    folder.mkdir(parents=True, exist_ok=True)
    handle = _taken(folder / NAME)
    try:
        yield folder
    finally:
        with suppress(OSError):
            os.unlink(folder / NAME)
        if handle is not None:
            os.close(handle)
        if made:
            with suppress(OSError):  # it holds results: the usual case
                folder.rmdir()


def swept(folder: Path) -> None:
    """Remove the lock that a run has left which was killed in the folder; one that is held stays."""
    if (folder / NAME).exists():
        with suppress(ValueError, OSError), locked(folder):
            pass


def _taken(path: Path) -> int | None:
    """The handle that holds the lock; None on a file system without locks, where the file alone has to do."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        try:
            held = _flock(handle)
            owner = _owner(handle)
            if held is False or (owner is not None and _may_live(owner, by_kernel=held is True)):
                raise ValueError(_refusal(path, owner))
            if not _is_at(handle, path):  # whoever had it has removed it between the two steps
                os.close(handle)
                continue
            mine = {"host": socket.gethostname(), "pid": os.getpid(), "started": time.strftime("%Y-%m-%d %H:%M:%S %z")}
            os.ftruncate(handle, 0)
            os.pwrite(handle, json.dumps(mine).encode(), 0)
        except BaseException:
            os.close(handle)
            raise
        return handle


def _flock(handle: int) -> bool | None:
    """Whether the kernel gave the lock; None where the file system has none."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _is_at(handle: int, path: Path) -> bool:
    try:
        there, mine = os.lstat(path), os.fstat(handle)
    except FileNotFoundError:
        return False
    return (there.st_dev, there.st_ino) == (mine.st_dev, mine.st_ino)


def _owner(handle: int) -> dict[str, Any] | None:
    """What the lock file says; None where it is empty or no lock."""
    try:
        found = json.loads(os.pread(handle, 4096, 0))
    except ValueError:
        return None
    return found if isinstance(found, dict) and isinstance(found.get("pid"), int) else None


def _may_live(owner: dict[str, Any], *, by_kernel: bool) -> bool:
    """Whether the process that wrote a lock may still be at work, where the kernel has given the lock or has none."""
    if owner.get("host") != socket.gethostname():
        return True
    if by_kernel or owner["pid"] == os.getpid():
        return False
    try:
        os.kill(owner["pid"], 0)
    except ProcessLookupError:
        return False
    except OSError:  # it lives and is somebody else's
        return True
    return True


def _refusal(path: Path, owner: dict[str, Any] | None) -> str:
    owner = owner or {}
    who = f"process {owner.get('pid', '?')} on {owner.get('host', '?')} since {owner.get('started', '?')}"
    cure = "wait for it or choose another --out"
    if owner.get("host") not in (None, socket.gethostname()):
        cure += f"; if that run is over, remove {path}"
    return f"--out {path.parent}: another run is at work there, {who}; {cure}"
