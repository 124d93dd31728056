"""The state of a run on disk, whole or not at all, and refused where it belongs to another run."""

from __future__ import annotations

import hashlib
import io
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geometry.recordings.whole_file import refuse_special, write_whole

from .parallel import from_lead, rank

_NAME = b"torchsph checkpoint "
_OPENING = _NAME + b"5\n"  # then the SHA-256 of all that follows its line, the key, and torch's own file


def run_key(parts: Mapping[str, Sequence[object]]) -> str:
    """The key of a run: its version and a fingerprint of each named part, so that a refusal can say which differs."""
    version = sys.modules["torchsph"].__version__  # this module's own package: to import it here would be a circle
    named = [f"{name}={fingerprint(part)}" for name, part in parts.items()]
    return ";".join([f"version of torchsph={version}", *named])


def fingerprint(parts: Iterable[object]) -> str:
    """A digest of arrays by their bytes and of everything else by its ``repr``."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(str((part.shape, part.dtype)).encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        else:
            digest.update(repr(part).encode())
        digest.update(b"\n")
    return digest.hexdigest()


def save(path: Path, key: str, state: dict[str, Any]) -> None:
    """Write a state of tensors and plain values; an interruption leaves the file that was there before.

    Of several processes the first alone writes.
    """
    if rank() > 0:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    packed = io.BytesIO()
    torch.save(state, packed)
    body = key.encode() + b"\n" + packed.getvalue()
    write_whole(path, b"%b%b\n%b" % (_OPENING, hashlib.sha256(body).hexdigest().encode(), body))


def refuse_other_file(path: Path) -> None:
    """Refuse to begin a run whose checkpoints would take the place of a file that is none.

    Raises:
        ValueError: it is somebody's file.
        FileExistsError: it is a link or a device, which no checkpoint would be written to.
    """
    refuse_special(path)
    if not path.exists():
        return
    with path.open("rb") as file:
        opening = file.read(len(_NAME))
    if opening != _NAME:
        raise ValueError(f"{path}: is no checkpoint, and would be replaced by one; move it, or choose another --out")


@dataclass(frozen=True)
class Saved:
    """A checkpoint that was read, once: every bit of it is the one that was written.

    Attributes:
        path: of the file.
        key: of the run that wrote it.
        packed: its state, as torch has packed it.
    """

    path: Path
    key: str
    packed: bytes = field(repr=False)

    @classmethod
    def read(cls, path: Path) -> Saved | None:
        """The checkpoint in ``path``, refused before any work is done where it is cut or changed; None: there is none.

        Raises:
            ValueError: it cannot be gone on from.
            FileExistsError: it is a link or a device, which no checkpoint would be written to.
        """
        refuse_special(path)
        return cls(path, *_verified(path)) if path.exists() else None

    def refuse_foreign(self, key: str) -> None:
        """Refuse to go on with it in another run.

        Raises:
            ValueError: it was written with other options, members, seed or recordings.
        """
        if self.key != key:
            differing = _differing(self.key, key)
            other = f"another {differing}" if differing else "other recordings, options, members, seed or version"
            raise ValueError(
                f"{self.path}: belongs to a run with {other}; resume with the same, or remove it and start anew"
            )

    def state(self, key: str) -> dict[str, Any]:
        """The state that was saved, for the run of that key.

        Raises:
            ValueError: as ``refuse_foreign``.
        """
        self.refuse_foreign(key)
        return torch.load(io.BytesIO(self.packed), weights_only=True)


def shared_state(saved: Saved | None, key: str) -> dict[str, Any] | None:
    """The state of a checkpoint, or None without one; of several processes the first has read it for all.

    Raises:
        ValueError: it was written by another run.
    """
    held: dict[str, Any] | ValueError | None = None
    if saved is not None and rank() == 0:
        try:
            held = saved.state(key)
        except ValueError as fault:  # told to all processes, which would wait for this one else
            held = fault
    found = from_lead(held)
    if isinstance(found, ValueError):
        raise found
    return found


def _differing(written: str, key: str) -> str:
    """The names of the parts in which two keys differ; nothing where they are not made alike."""
    one, other = (dict(part.partition("=")[::2] for part in each.split(";")) for each in (written, key))
    return ", ".join(name for name in other if one[name] != other[name]) if one.keys() == other.keys() else ""


def _verified(path: Path) -> tuple[str, bytes]:
    """The key and the packed state, whose every bit is the one that was written."""
    if not path.is_file():
        raise ValueError(f"{path}: is not a file, so it is no checkpoint; remove it and start anew")
    content = path.read_bytes()
    if not content.startswith(_OPENING):
        rule = "is no checkpoint of this version of torchsph, or its beginning is damaged"
        raise ValueError(f"{path}: {rule}; remove it and start anew, without --resume")
    digest, _, body = content[len(_OPENING) :].partition(b"\n")
    if hashlib.sha256(body).hexdigest().encode() != digest:
        rule = "is damaged: its bytes are not those that were written (a bad disk, or a copy that was cut)"
        raise ValueError(f"{path}: {rule}; copy it again, or remove it and start anew, without --resume")
    key, _, packed = body.partition(b"\n")
    return key.decode(), packed
