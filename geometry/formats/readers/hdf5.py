"""HDF5 of any layout, by h5py; links to other files are never followed."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from geometry.formats.source import FormatError, Source


def open_hdf5(path: Path) -> Source:
    """All numeric datasets of a file by their paths without the first slash; attributes with each."""
    try:
        file = h5py.File(path, "r")
    except OSError as fault:
        raise FormatError(f"{path}: is no readable HDF5 file ({fault})") from fault
    arrays = datasets(file)
    attributes = {name: dict(node.attrs) for name, node in arrays.items()}
    return Source(str(path), arrays, attributes, close=file.close)


def datasets(group: h5py.Group) -> dict[str, h5py.Dataset]:
    """Numeric datasets below a group whose values lie in this file."""
    found: dict[str, h5py.Dataset] = {}

    def visit(name: str, node: object) -> None:
        # visititems passes by soft and external links.
        if (
            isinstance(node, h5py.Dataset)
            and node.dtype.kind in "fiub"
            and node.external is None
            and not node.is_virtual
        ):
            found[name] = node

    group.visititems(visit)
    return found


def text(value: object) -> str:
    """An attribute as text, whatever its HDF5 string type."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
