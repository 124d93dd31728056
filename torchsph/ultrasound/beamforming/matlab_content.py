"""What a MATLAB file holds, in one form for versions 5 to 7 (SciPy) and 7.3 (h5py)."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

Content = np.ndarray | list["Content"] | dict[str, "Content"]
"""Numbers with MATLAB's order of axes, the contents of a cell array, or the fields of a structure."""

MOST = 4096  # cells of an array


def matlab_content(path: Path) -> dict[str, Content]:
    """The variables of a file; what is none of numbers, cells or structures is left out.

    Args:
        path: of the file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no MATLAB file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    try:
        if h5py.is_hdf5(path):
            with h5py.File(path, "r") as file:
                return {name: found for name in file if (found := _of_hdf5(file, file[name])) is not None}
        from scipy.io import loadmat

        loaded = loadmat(str(path), squeeze_me=False, struct_as_record=False)
    except (MemoryError, FileNotFoundError):
        raise
    except Exception as fault:  # SciPy's and HDF5's readers have errors of many kinds
        raise ValueError(f"{path}: is no MATLAB file of version 5 to 7.3 ({fault}); save it again") from fault
    return {
        name: found
        for name, value in loaded.items()
        if not name.startswith("__") and (found := _of_scipy(value)) is not None
    }


def _of_scipy(value: object) -> Content | None:
    names = getattr(value, "_fieldnames", None)
    if names is not None:
        fields = {name: _of_scipy(getattr(value, name)) for name in names}
        return {name: field for name, field in fields.items() if field is not None}
    array = np.asarray(value)
    if array.dtype.kind in "fiucb":
        return array
    if array.dtype != object or array.size > MOST:
        return None
    parts = [found for one in array.reshape(-1, order="F") if (found := _of_scipy(one)) is not None]
    single = len(parts) == 1 and isinstance(parts[0], dict)  # a structure comes as an array of one
    return parts[0] if single else parts


def _of_hdf5(file: h5py.File, node: h5py.Group | h5py.Dataset) -> Content | None:
    if isinstance(node, h5py.Group):
        if node.name.startswith("/#"):  # what cells refer to
            return None
        fields = {name: _of_hdf5(file, node[name]) for name in node}
        return {name: field for name, field in fields.items() if field is not None}
    kind = node.attrs.get("MATLAB_class", b"")
    if node.dtype == h5py.ref_dtype:
        if node.size > MOST:
            return None
        cells = [file[one] for one in node[()].T.reshape(-1, order="F")]
        return [found for one in cells if (found := _of_hdf5(file, one)) is not None]
    if node.dtype.names == ("real", "imag"):
        stored = node[()]
        return (stored["real"] + 1j * stored["imag"]).T
    if node.dtype.kind not in "fiub" or kind == b"char" or node.external is not None or node.is_virtual:
        return None
    return np.asarray(node[()]).T
