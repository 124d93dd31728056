"""Files that appear whole or not at all: every step on the way to the disk is checked."""

from __future__ import annotations

import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

_PIECE = 1 << 30  # bytes of one call; Linux takes no more than 2 GiB

# what file systems answer that cannot flush a folder; the file itself is on the disk by then
_NO_FLUSH = {errno.EINVAL, errno.ENOTSUP, errno.EACCES, errno.EBADF}


def write_whole(path: str | Path, content: bytes | memoryview) -> None:
    """Write a file, replacing a regular file of that name.

    The bytes go to another name in the same folder, are flushed to the disk and then renamed, so that whoever looks
    sees the old file or the new one, never a part. Where a step fails, the old file stays and nothing is left behind.

    Args:
        path: of the file.
        content: all of it.

    Raises:
        FileNotFoundError: there is no such folder.
        OSError: the disk is full, the folder cannot be written to, or something other than a regular file (a link, a
            device, a folder) has the name and would be lost.
    """
    path = Path(path)
    refuse_special(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no directory {path.parent}; make it first")
    try:
        _place(path, content)
        _flush_folder(path.parent)
    except OSError as fault:
        if fault.errno is None:
            raise
        raise OSError(fault.errno, fault.strerror, str(path)) from fault  # not the name in between, which is gone


def _place(path: Path, content: bytes | memoryview) -> None:
    handle, name = tempfile.mkstemp(prefix=f".{path.name[:100]}.", suffix=".part", dir=path.parent)
    try:
        try:
            _write(handle, memoryview(content))
            os.fchmod(handle, 0o666 & ~_umask())
            os.fsync(handle)
        finally:
            os.close(handle)  # a network's disk may be full only here
        os.replace(name, path)
    except BaseException:
        with suppress(OSError):  # the folder may be gone, and the first fault is the one to tell
            os.unlink(name)
        raise


def move_together(files: Sequence[Path], folder: Path) -> None:
    """Move finished files into a folder, all of them or none.

    Each is flushed to the disk before the first is moved; where a step fails, files that were replaced come back.

    Args:
        files: on the same file system as the folder, in another one that is the caller's alone.
        folder: where they go, under their names; a file of that name is replaced.

    Raises:
        FileExistsError: something other than a regular file has one of the names; nothing was moved.
        OSError: a file could not be flushed or moved; the folder is as it was.
    """
    for file in files:
        refuse_special(folder / file.name)
    for file in files:
        _flush(file)
    moved: list[tuple[Path, Path | None]] = []
    try:
        for file in files:
            target, older = folder / file.name, file.with_name(f".{file.name[:100]}.older")
            if target.exists():
                os.rename(target, older)
                moved.append((target, older))
            else:
                moved.append((target, None))
            os.replace(file, target)
        _flush_folder(folder)
    except BaseException:
        for target, earlier in reversed(moved):
            with suppress(OSError):  # the first fault is the one to tell
                if earlier is not None:
                    os.replace(earlier, target)
                else:
                    os.unlink(target)
        raise
    for _, earlier in moved:
        if earlier is not None:
            with suppress(OSError):  # the caller's folder goes away with it
                os.unlink(earlier)


@contextmanager
def written_together(folder: Path) -> Iterator[Path]:
    """A scratch folder whose files move into `folder` together when the block ends well, and vanish otherwise.

    Args:
        folder: an existing one, where the files are wanted.

    Raises:
        FileExistsError: something other than a regular file has one of their names.
        OSError: a step failed; the folder is as it was.
    """
    scratch = Path(tempfile.mkdtemp(prefix=".files-", dir=folder))
    try:
        yield scratch
        move_together(sorted(scratch.iterdir()), folder)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def refuse_special(path: str | Path) -> None:
    """Refuse a name that a rename would take from a link, a device, a pipe or a folder.

    Args:
        path: of a file that is about to be written.

    Raises:
        FileExistsError: something other than a regular file has the name.
    """
    try:
        mode = os.lstat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    if not stat.S_ISREG(mode):
        kinds = {stat.S_IFLNK: "a symbolic link", stat.S_IFDIR: "a folder"}
        kind = kinds.get(stat.S_IFMT(mode), "a device, a pipe or a socket")
        raise FileExistsError(f"{path}: is {kind}, which writing would replace; name a regular file or a new one")


def _write(handle: int, content: memoryview) -> None:
    """All bytes: a call may take fewer than it was given, on a disk that is nearly full for one."""
    rest = content.cast("B")
    while rest:
        taken = os.write(handle, rest[:_PIECE])
        if taken <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        rest = rest[taken:]


def _flush(file: Path) -> None:
    handle = os.open(file, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _flush_folder(folder: Path) -> None:
    """Make the new name outlast a loss of power, where the file system knows how."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:  # a folder that may be written to but not listed
        return
    try:
        os.fsync(handle)
    except OSError as fault:
        if fault.errno not in _NO_FLUSH:
            raise
    finally:
        os.close(handle)


def _umask() -> int:
    """The process's file mode mask: mkstemp ignores it, but the file should be as readable as any other."""
    current = os.umask(0)
    os.umask(current)
    return current
