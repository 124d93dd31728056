"""Recordings as xarray datasets: named axes, coordinates, units and CF attributes, there and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geometry.arguments import checked, shown
from geometry.grids.grid import Grid
from geometry.recordings.opening_flux import GROUP, fluxes_of, is_flux
from geometry.recordings.quality import QUALITY_NAMES, Quality
from geometry.recordings.recording import LAYOUT, Recording, Wall

from .source import FormatError, missing_extra

if TYPE_CHECKING:
    import xarray

SPACE = {2: ("y", "x"), 3: ("z", "y", "x")}
ATTRIBUTES = {
    "velocity": {"units": "m s-1", "long_name": "velocity of the blood"},
    "mask": {"long_name": "1 in the blood", "flag_values": np.array([0, 1], np.int8), "flag_meanings": "outside blood"},
    "weight": {"units": "1", "long_name": "confidence"},
    "quality": {
        "flag_values": np.array(list(Quality), np.uint8),
        "flag_meanings": " ".join(name.replace(" ", "_") for name in QUALITY_NAMES),
    },
    "sigma": {"units": "m s-1", "long_name": "standard deviation of the velocity"},
    "beam": {"units": "1", "long_name": "unit vector along the beam"},
    "normal": {"units": "1", "long_name": "unit vector along which nothing was measured"},
    "nyquist": {"units": "m s-1", "long_name": "speed at which the measurement wraps"},
    "pressure": {"units": "Pa", "long_name": "pressure"},
    "pressure_sigma": {"units": "Pa", "long_name": "standard deviation of the pressure"},
    "wall_vertices": {"units": "m"},
    "wall_velocity": {"units": "m s-1"},
    "wall_sigma": {"units": "m", "long_name": "standard deviation of a vertex's place"},
    "valve_intervals": {"units": "s", "long_name": "region, opens, closes"},
    "valve_leak": {"units": "1", "long_name": "region, part that stays open"},
    "volume": {"units": "m3"},
    "flux_mitral": {"units": "m3 s-1", "long_name": "flux into the ventricle"},
    "flux_aortic": {"units": "m3 s-1", "long_name": "flux into the ventricle"},
}


@checked
def to_xarray(recording: Recording) -> xarray.Dataset:
    """A dataset with the dimensions time, component, z, y, x and coordinates in s and m."""
    try:
        import xarray
    except ImportError as fault:
        raise missing_extra("to_xarray", "xarray") from fault
    variables = {}
    for name, _, _ in LAYOUT:
        holder, field = (recording.wall, name[5:]) if name.startswith("wall.") else (recording, name)
        values = None if holder is None else getattr(holder, field)
        if values is None or name == "time":
            continue
        label = name.replace(".", "_")
        values = values.astype(np.int8) if values.dtype == np.bool_ else values
        variables[label] = (_dimensions(name, recording, values.ndim), values, ATTRIBUTES.get(label, {}))
    for dataset, values in (item for flux in recording.fluxes for item in flux.arrays().items()):
        about_flux = {"units": "m3 s-1", "long_name": "measured flux into the blood"}
        variables[dataset.strip("/").replace("/", "_")] = (("time",), values, about_flux)
    grid = recording.grid
    places = {
        axis: grid.origin[number] + grid.spacing[number] * np.arange(grid.shape[-1 - number])
        for number, axis in enumerate("xyz"[: recording.dimension])
    }
    coordinates: dict[str, tuple] = {
        axis: (axis, values, {"units": "m", "axis": axis.upper()}) for axis, values in places.items()
    }
    coordinates["time"] = ("time", recording.time, {"units": "s", "axis": "T", "long_name": "time in the beat"})
    coordinates["component"] = ("component", list("xyz"[: recording.dimension]), {})
    about = {name: getattr(recording, name) for name in ("rho", "mu", "period", "description")}
    about |= {"cut": 1} if recording.cut else {}
    lattice = {"origin": np.array(grid.origin), "spacing": np.array(grid.spacing)}
    return xarray.Dataset(variables, coordinates, {"Conventions": "CF-1.11", **about, **lattice})


def from_xarray(dataset: xarray.Dataset) -> Recording:
    """A recording from a dataset as `to_xarray` makes it.

    Raises:
        FormatError: a variable, coordinate or attribute is missing, or coordinates are not evenly spaced.
        RecordingError: shapes disagree.
        TypeError: it is no dataset.
    """
    if not hasattr(dataset, "dims") or not hasattr(dataset, "variables"):
        raise TypeError(f"from_xarray: dataset must be an xarray Dataset, got {shown(dataset)}")
    dimension = 3 if "z" in dataset.dims else 2
    missing = [name for name in ("velocity", "mask", "time", *SPACE[dimension]) if name not in dataset.variables]
    missing += [name for name in ("rho", "mu") if name not in dataset.attrs]
    if missing:
        raise FormatError(f"from_xarray: the dataset has no {', '.join(missing)}")
    values = {}
    for name, _, _ in LAYOUT:
        label = name.replace(".", "_")
        if label in dataset.variables:
            one = dataset[label]
            wanted = _named(name, dimension, one.dims)
            values[name] = one.transpose(*wanted).values
    wall = {name[5:]: array for name, array in values.items() if name.startswith("wall.")}
    rest = {name: array for name, array in values.items() if not name.startswith("wall.")}
    about = {name: dataset.attrs[name] for name in ("rho", "mu", "period", "description") if name in dataset.attrs}
    about |= {"cut": True} if dataset.attrs.get("cut") else {}
    whole: dict[str, Any] = {**rest, **about, **({"wall": Wall(**wall)} if wall else {})}
    labels = {str(label).replace("flux_", f"{GROUP}/", 1): label for label in dataset.variables}
    whole["fluxes"] = fluxes_of({name: dataset[label].values for name, label in labels.items() if is_flux(name)})
    return Recording(grid=_grid(dataset, dimension), **whole)


def _named(name: str, dimension: int, present: tuple) -> tuple:
    """The order of axes of a recording for the dimensions that a variable has."""
    order = ("time", "component", *SPACE[dimension])
    return tuple(dim for dim in order if dim in present) if set(present) <= set(order) else present


def _dimensions(name: str, recording: Recording, rank: int) -> tuple[str, ...]:
    space = SPACE[recording.dimension]
    table = {
        "velocity": ("time", "component", *space),
        "sigma": ("time", "component", *space),
        "beam": ("time", "component", *space)[-rank:],
        "normal": ("time", "component", *space)[-rank:],
        "nyquist": ("time", "component")[:rank],
        "wall.vertices": ("time", "vertex", "component")[-rank:],
        "wall.velocity": ("time", "vertex", "component"),
        "wall.sigma": ("time", "vertex")[-rank:],
        "wall.faces": ("face", "corner"),
        "wall.region": ("face",),
        "valve_intervals": ("interval", "column"),
        "valve_leak": ("valve_with_leak", "column_of_leak"),
        "valve_open": ("time", "valve"),
    }
    return table.get(name, ("time", *space) if rank > 1 else ("time",))


def _grid(dataset: xarray.Dataset, dimension: int) -> Grid:
    """By the exact attributes where they fit the coordinates, else by the coordinates."""
    axes = "xyz"[:dimension]
    shape = tuple(dataset.sizes[axis] for axis in reversed(axes))
    origin = [float(dataset[axis].values[0]) for axis in axes]
    spacing = []
    for axis in axes:
        steps = np.diff(dataset[axis].values.astype(np.float64))
        if len(steps) and np.abs(steps - steps.mean()).max() > 1e-4 * abs(steps.mean()):
            raise FormatError(f"from_xarray: the coordinate {axis} is not evenly spaced; interpolate to a regular grid")
        spacing.append(float(steps.mean()) if len(steps) else 1.0)
    for values, name in ((origin, "origin"), (spacing, "spacing")):
        stated = np.asarray(dataset.attrs.get(name, []), np.float64)
        single = [dataset.sizes[axis] == 1 and name == "spacing" for axis in axes]
        if stated.shape == (dimension,) and all(
            alone or abs(a - b) <= 1e-6 * max(spacing) for a, b, alone in zip(values, stated, single, strict=True)
        ):
            values[:] = stated.tolist()
    return Grid(tuple(origin), tuple(spacing), shape)
