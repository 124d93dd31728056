"""The state of a run on disk, whole or not at all, and refused where it belongs to another run."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist

_FORMAT = 3


def fingerprint(parts: Iterable[object]) -> str:
    """A digest of arrays by their bytes and of everything else by its ``repr``."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(str((part.shape, part.dtype)).encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        else:
            digest.update(repr(part).encode())
    return digest.hexdigest()


def save(path: Path, key: str, state: dict[str, Any]) -> None:
    """Write a state of tensors and plain values; an interruption leaves the file that was there before.

    Of several processes the first alone writes.
    """
    if dist.is_initialized() and dist.get_rank() > 0:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".part")
    with open(draft, "wb") as file:
        torch.save({"format": _FORMAT, "key": key, "state": state}, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(draft, path)


def load(path: Path, key: str) -> dict[str, Any] | None:
    """The state in ``path``, or None where there is none; of several processes the first reads for all.

    Raises:
        ValueError: it was written by another run: other options, members, seed or recordings.
    """
    held: list[dict[str, Any] | None] = [None]
    lead = not dist.is_initialized() or dist.get_rank() == 0
    if lead and path.exists():
        held = [torch.load(path, weights_only=True)]
    if dist.is_initialized():
        dist.broadcast_object_list(held, 0)
    found = held[0]
    if found is None:
        return None
    if found.get("format") != _FORMAT or found.get("key") != key:
        raise ValueError(
            f"{path}: belongs to a run with other recordings, options, members or seed; remove it, or resume with the "
            "same ones"
        )
    return found["state"]
