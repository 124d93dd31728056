"""NetCDF and Zarr, by xarray: dimensions, coordinates and their units as the file has them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geometry.formats.source import FormatError, Source, missing_extra
from geometry.recordings.units import factor

if TYPE_CHECKING:
    import xarray


def open_xarray(path: Path) -> Source:
    """All variables by their names; packed ones are unpacked by xarray, on access."""
    try:
        import xarray
    except ImportError as fault:
        raise missing_extra(path, "xarray") from fault
    options = {"engine": "zarr", "consolidated": None} if path.suffix == ".zarr" else {}
    try:
        dataset = xarray.open_dataset(path, decode_times=False, **options)
    except (ValueError, OSError, ImportError) as fault:
        raise FormatError(f"{path}: xarray cannot read it ({str(fault).splitlines()[0]})") from fault
    letters = {dim: _letter(str(dim), dataset) for dim in dataset.dims}
    variables = {str(name): dataset[name].variable for name in dataset.data_vars if dataset[name].dtype.kind in "fiub"}
    axes = {name: "".join(letters[dim] for dim in one.dims) for name, one in variables.items()}
    places = {letter: dataset[dim] for dim, letter in letters.items() if dim in dataset.coords}
    space = [letter for letter in "xyz" if letter in places]
    affine = _affine([places[letter].values for letter in space], str(path)) if len(space) >= 2 else None
    return Source(
        str(path),
        {name: Stored(one) for name, one in variables.items()},
        {name: {key: one.attrs[key] for key in ("units",) if key in one.attrs} for name, one in variables.items()},
        {name: word for name, word in axes.items() if "?" not in word},
        affine,
        _unit([places[letter] for letter in space], "length", str(path)),
        time=None if "t" not in places else places["t"].values * (_unit([places["t"]], "time", str(path)) or 1.0),
        roles=_roles(variables),
        close=dataset.close,
    )


class Stored:
    """A variable with the pieces that it is stored in, where it is."""

    def __init__(self, variable: xarray.Variable) -> None:
        self._variable = variable
        self.shape, self.dtype = variable.shape, variable.dtype
        self.chunks = variable.encoding.get("chunks") or variable.encoding.get("chunksizes")

    def __getitem__(self, index: tuple) -> np.ndarray:
        return self._variable[index].values


def _letter(dim: str, dataset: xarray.Dataset) -> str:
    name = dim.lower()
    axis = str(dataset[dim].attrs.get("axis", "")).lower() if dim in dataset.coords else ""
    if axis in ("t", "x", "y", "z"):
        return axis
    if name in ("t", "time", "frame", "frames"):
        return "t"
    return name if name in ("x", "y", "z") else "c" if name in ("component", "components", "c", "vector") else "?"


def _affine(coordinates: list[np.ndarray], path: str) -> np.ndarray:
    steps, starts = [], []
    for values in coordinates:
        step = np.diff(values.astype(np.float64))
        if len(step) and np.abs(step - step.mean()).max() > 1e-3 * abs(step.mean()):
            raise FormatError(f"{path}: its coordinates are not evenly spaced; interpolate it to a regular grid")
        steps.append(float((values[-1] - values[0]) / (len(values) - 1)) if len(step) else 1.0)
        starts.append(float(values[0]))
    affine = np.diag([*steps, 1.0])
    affine[:-1, -1] = starts
    return affine


def _unit(coordinates: list, quantity: str, path: str) -> float | None:
    names = {str(one.attrs["units"]).split(" since ")[0] for one in coordinates if "units" in one.attrs}
    if len(names) > 1:
        raise FormatError(f"{path}: its coordinates have different units: {', '.join(sorted(names))}")
    try:
        return factor(names.pop(), quantity) if names else None
    except ValueError as fault:
        raise FormatError(f"{path}: {fault}") from fault


def _roles(variables: dict) -> dict[str, tuple[str, ...]]:
    """Velocities by their names, as xarray users call them."""
    roles: dict[str, tuple[str, ...]] = {name: (name,) for name in ("mask", "weight", "sigma") if name in variables}
    for names in (("velocity",), ("u", "v", "w"), ("vx", "vy", "vz"), ("u", "v")):
        if all(name in variables for name in names):
            return roles | {"velocity": names}
    return roles
