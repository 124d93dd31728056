"""Where a result comes from: version, settings, inputs and machine, as every output records them."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from torchsph import __version__

from .settings import settings_of

DEPENDENCIES = ("torch", "numpy", "scipy", "trimesh", "h5py")

Inputs = Mapping[str, str | Path | list[str] | None]


def provenance(args: argparse.Namespace, inputs: Inputs) -> dict[str, Any]:
    """Everything that made a result: what is the same for two results makes them the same.

    Args:
        args: the command's options.
        inputs: files by what they are; None and empty lists are left out.
    """
    digests = input_digests(inputs)
    torch = sys.modules.get("torch")
    return {
        "torchsph": __version__,
        "commit": commit(),
        "command": args.command,
        "settings": {name: value for name, value in settings_of(args).items() if name not in inputs},
        "seed": getattr(args, "seed", None),
        "device": _device(getattr(args, "device", "cpu")),
        "threads": None if torch is None else torch.get_num_threads(),
        "processes": int(os.environ.get("WORLD_SIZE", "1")),
        "inputs": digests,
        "fingerprint": fingerprint(args, digests),
        "dependencies": {name: _version(name) for name in DEPENDENCIES} | {"python": platform.python_version()},
        "machine": platform.platform(),
        "use": "for research, not for clinical use",
    }


def input_digests(inputs: Inputs) -> dict[str, dict[str, str]]:
    """For each kind of input its files with their SHA-256."""
    several = {kind: found if isinstance(found, list) else [found] for kind, found in inputs.items() if found}
    return {kind: {str(path): _sha256(Path(str(path))) for path in paths} for kind, paths in several.items() if paths}


def fingerprint(args: argparse.Namespace, digests: Mapping[str, Mapping[str, str]]) -> str:
    """A digest of version, command, settings and the content of all inputs, wherever they lie."""
    content = {kind: list(files.values()) for kind, files in digests.items()}
    settings = {name: value for name, value in settings_of(args).items() if name not in digests}
    told = json.dumps([__version__, args.command, settings, content], sort_keys=True, default=str)
    return hashlib.sha256(told.encode()).hexdigest()


@cache
def commit() -> str | None:
    """The commit of the checkout that runs, with "+changed" where files differ from it, or of the installed package."""
    root = Path(__file__).resolve().parents[3]
    if (root / ".git").exists():
        call = ["git", "-C", str(root), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+changed"]
        try:
            return subprocess.run(call, capture_output=True, text=True, timeout=10, check=True).stdout.strip() or None
        except (OSError, subprocess.SubprocessError):
            return None
    try:
        text = metadata.distribution("torchsph").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        return None
    found = json.loads(text or "{}").get("vcs_info", {}).get("commit_id")
    return None if found is None else str(found)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _device(name: str) -> str:
    """The device with its model, which decides on the last digits."""
    torch = sys.modules.get("torch")
    if torch is not None and name.startswith("cuda") and torch.cuda.is_available():
        return f"{name} ({torch.cuda.get_device_name(name)})"
    return f"{name} ({platform.machine()})"
