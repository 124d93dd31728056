"""Text files that a command is given: read without waiting for a pipe, and without swallowing a device."""

from __future__ import annotations

import os
import stat
from pathlib import Path

LARGEST = 64 << 20  # bytes


def read_small(path: str | Path) -> bytes:
    """The bytes of a settings file, a list or a document.

    Raises:
        OSError: it is not there, or may not be read.
        ValueError: it is no regular file, or far larger than any of its kind.
    """
    about = os.stat(path)
    if not stat.S_ISREG(about.st_mode):
        kind = "a folder" if stat.S_ISDIR(about.st_mode) else "a device, a pipe or a socket"
        raise ValueError(f"{path}: is {kind}; name a regular file")
    if about.st_size > LARGEST:
        raise ValueError(f"{path}: has {about.st_size / 1e6:.0f} MB, and no text of this kind has; name another file")
    return Path(path).read_bytes()
