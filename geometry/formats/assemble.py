"""From the arrays of a file and a field map to the fields of a recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from geometry.grids.grid import Grid
from geometry.recordings.odd_files import PACKED, UNWRITTEN
from geometry.recordings.units import factor

from .field_map import FieldMap
from .orientation import Orientation
from .placing import fill_scalar, fill_vectors
from .source import ArrayLike, FormatError, Source

MIRROR = {"ras": np.array([-1.0, -1.0, 1.0])}  # to LPS, the coordinates that DICOM, ITK and surfaces of Slicer use
WHOLE = (
    ".h5",
    ".hdf5",
    ".hdf",
    ".he5",
    ".mat",
    ".npz",
    ".vtkhdf",
    ".nc",
    ".nc4",
    ".nii",
    ".gz",
    ".nrrd",
    ".mha",
    ".vti",
    ".vtk",
    ".zarr",
)
DECLARED = 64 * 2**30  # bytes; a file that claims a larger result is refused before anything is read


@dataclass(frozen=True, eq=False)
class Fields:
    """What a recording takes over, and what its user should know about it.

    Attributes:
        grid: of all fields.
        time: (T,), s.
        velocity: (T, D, *grid), m/s, float32; NaN where the file has no value.
        mask: (T, *grid), bool, or None.
        weight: (T, *grid), 0 to 1, or None.
        sigma: (T, D, *grid), m/s, or None.
        turn: (D, D), rotation from the recording's coordinates to the file's; walls are turned back by it.
        notes: sentences for the user.
    """

    grid: Grid
    time: np.ndarray
    velocity: np.ndarray
    mask: np.ndarray | None
    weight: np.ndarray | None
    sigma: np.ndarray | None
    turn: np.ndarray
    notes: list[str] = field(default_factory=list)


def assemble(source: Source, said: FieldMap) -> Fields:
    """The fields of a file, in SI units, in the order and sense of a recording's axes.

    Raises:
        FormatError: an array is missing or of the wrong shape, or what is not known is not said.
    """
    names = _velocity_names(source, said)
    axes = [_axes(source, said, name, len(names) == 1) for name in names]
    sizes = [dict(zip(a, source.arrays[n].shape, strict=True)) for a, n in zip(axes, names, strict=True)]
    dimension = 3 if "z" in axes[0] else 2
    _check_components(source, names, sizes, dimension, sizes[0])
    counts = tuple(sizes[0][letter] for letter in "xyz"[:dimension])
    frames = sizes[0].get("t", 1)
    _check_size(source, names[0], 4 * dimension * frames * math.prod(counts), f"{frames} frames of {counts} nodes")
    lie = Orientation.of(_affine(source, said, counts), counts, source.path)
    grid = Grid(tuple(lie.origin), tuple(lie.spacing), tuple(counts[lie.order[a]] for a in reversed(range(dimension))))
    matrix = _matrix(source, said, lie)
    unit = said.unit("velocity") or source.velocity_unit
    velocity = np.zeros((frames, dimension, *grid.shape), np.float32)
    fill_vectors(velocity, _vectors(source, names, axes, unit), lie, matrix)
    sigma = None
    if said.sigma:
        sigma = np.zeros_like(velocity)
        letters = [_axes(source, said, name, len(said.sigma) == 1) for name in said.sigma]
        spread = [dict(zip(a, source.arrays[n].shape, strict=True)) for a, n in zip(letters, said.sigma, strict=True)]
        _check_components(source, said.sigma, spread, dimension, sizes[0])
        fill_vectors(sigma, _vectors(source, said.sigma, letters, unit), lie, np.abs(matrix))
    whole = (frames, counts)
    mask = _scalar(source, said, said.mask or _role(source, "mask"), lie, whole, (bool, said.inside))
    weight = _scalar(source, said, said.weight or _role(source, "weight"), lie, whole, (np.float32, np.asarray))
    notes = _notes(source, said, lie, unit)
    return Fields(grid, _time(source, said, frames), velocity, mask, weight, sigma, lie.turn, notes)


def _role(source: Source, name: str) -> str:
    return next(iter(source.roles.get(name, ())), "")


def _velocity_names(source: Source, said: FieldMap) -> tuple[str, ...]:
    names = tuple(said.velocity) or tuple(source.roles.get("velocity", ()))
    listed = ", ".join(f"{name} {tuple(array.shape)}" for name, array in source.arrays.items()) or "none"
    if not names:
        raise FormatError(
            f"{source.path}: which arrays are the velocity? Name them (--velocity u,v,w); it holds {listed}"
        )
    missing = [name for name in (*names, *said.sigma, said.mask, said.weight) if name and name not in source.arrays]
    if missing:
        raise FormatError(f"{source.path}: has no array {', '.join(missing)}; it holds {listed}")
    return names


def _axes(source: Source, said: FieldMap, name: str, vector: bool) -> str:
    """The meaning of the axes of an array, a letter each, in array order."""
    shape = source.arrays[name].shape
    known = source.axes.get(name, "")
    if len(known) == len(shape) and not (said.axes and said.axes != "auto"):
        return known
    space = said.axes if said.axes and said.axes != "auto" else "zyx"[max(0, 3 - len(shape)) :]
    if len(space) > len(shape):
        space = "".join(letter for letter in space if letter in "xyz" or len(shape) == len(said.axes))
    left = len(shape) - len(space)
    if vector and "c" not in space and left > 0:
        components = [0, left - 1, len(shape) - 1] if "t" not in space else [0, len(shape) - 1]
        fits = [place for place in dict.fromkeys(components) if shape[place] in (2, 3)]
        if len(fits) == 1:
            rest = len(shape) - len(space) - 1
            lead = "t" * min(rest, 1)
            space = (
                lead + space + "c"
                if fits[0] == len(shape) - 1
                else "".join(["c" if place == fits[0] else "t" for place in range(left)]) + space
            )
    elif left == 1 and "t" not in space:
        space = "t" + space
    if len(space) != len(shape):
        raise FormatError(
            f"{source.path}: {name}: what do the axes of its shape {tuple(shape)} mean? Say it with a letter for each "
            "of t, c, x, y, z in that order (--axes tczyx)"
        )
    return space


def _check_components(
    source: Source, names: Sequence[str], sizes: list[dict[str, int]], dimension: int, velocity: dict[str, int]
) -> None:
    """Refuse arrays of a vector field that are not as the first one of the velocity, or too many or few."""
    first = {letter: size for letter, size in velocity.items() if letter != "c"}
    for name, size in zip(names, sizes, strict=True):
        if {letter: count for letter, count in size.items() if letter != "c"} != first:
            raise FormatError(f"{source.path}: {name} has the shape {size}, but the velocity has {velocity}")
    count = sizes[0].get("c", 1) * len(names)
    if count != dimension and (dimension, count, len(names)) != (2, 3, 1):  # a plane of vectors in space: its z is left
        raise FormatError(
            f"{source.path}: {dimension} components of velocity are needed, not {count} ({', '.join(names)})"
        )


def _check_size(source: Source, name: str, needed: int, claimed: str) -> None:
    """Refuse, before anything is read, a result larger than memory or than the file can have packed."""
    if needed > DECLARED:
        raise FormatError(f"{source.path}: {name}: claims {claimed}, more than memory holds")
    path = Path(source.path)
    size = sum(part.stat().st_size for part in (path.rglob("*") if path.is_dir() else [path]) if part.is_file())
    if path.suffix.lower() in WHOLE and path.exists() and needed > UNWRITTEN + PACKED * size:
        raise FormatError(
            f"{source.path}: {name}: claims {claimed}, but the whole file has {size} bytes; write the "
            "values, or name other arrays"
        )


def _affine(source: Source, said: FieldMap, counts: tuple[int, ...]) -> np.ndarray:
    """From node numbers to places in metres, in LPS where the file is of a patient."""
    dimension = len(counts)
    affine = None if source.affine is None else np.array(source.affine, np.float64)
    if affine is not None and len(affine) == 4 and dimension == 2:
        affine = affine[np.ix_([0, 1, 3], [0, 1, 3])]
    unit = said.unit("length") or source.length
    if said.spacing or affine is None:
        spacing = _spacing(source, said, dimension)
        start = said.origin or (0.0,) * dimension
        if affine is not None:
            turned = affine[:-1, :-1] / np.linalg.norm(affine[:-1, :-1], axis=0)
            affine[:-1, :-1] = turned * spacing
        else:
            affine = np.eye(dimension + 1)
            affine[:-1, :-1], affine[:-1, -1] = np.diag(spacing), start
    elif said.origin:
        affine[:-1, -1] = said.origin
    if unit is None:
        raise FormatError(f"{source.path}: in which unit are its lengths? Say it (--length-unit mm)")
    affine[:-1] *= unit
    if source.world in MIRROR:
        affine[:-1] *= MIRROR[source.world][:, None]
    return affine


def _spacing(source: Source, said: FieldMap, dimension: int) -> np.ndarray:
    if not said.spacing:
        raise FormatError(f"{source.path}: how far are its nodes apart? Say it (--spacing 1.2 or --spacing DATASET)")
    if isinstance(said.spacing, str):
        if said.spacing not in source.arrays:
            raise FormatError(f"{source.path}: has no array {said.spacing} of spacings")
        array = source.arrays[said.spacing]
        if int(np.prod(array.shape)) > 1000:
            raise FormatError(f"{source.path}: {said.spacing}: has the shape {array.shape}, too large for spacings")
        values = np.asarray(array[(...,)], np.float64).reshape(-1)
        values = values[:dimension] if len(values) % dimension == 0 else values[:1]
    else:
        values = np.asarray(said.spacing, np.float64)
    if len(values) not in (1, dimension):
        raise FormatError(f"{source.path}: spacing must be 1 or {dimension} numbers, not {values.tolist()}")
    return np.broadcast_to(values, (dimension,))


def _matrix(source: Source, said: FieldMap, lie: Orientation) -> np.ndarray:
    """(D, D): recorded components from the stored ones."""
    dimension = len(lie.order)
    stored = np.eye(dimension)
    if said.components:
        stored = np.zeros((dimension, dimension))
        for place, word in enumerate(said.components.replace(" ", "").split(",")):
            letter = word.lstrip("+-")
            if letter not in "xyz"[:dimension] or not letter or place >= dimension:
                raise FormatError(
                    f"components: must be {dimension} of x, y, z with signs, as -y,x,z, not {said.components}"
                )
            stored["xyz".index(letter), place] = -1.0 if word.startswith("-") else 1.0
        if abs(abs(np.linalg.det(stored)) - 1) > 1e-9:
            raise FormatError(f"components: must name each axis once, not {said.components}")
    if said.image_components:
        return lie.components() @ stored
    world = np.diag(MIRROR[source.world][:dimension]) if source.world in MIRROR else np.eye(dimension)
    return lie.turn.T @ world @ stored


def _vectors(
    source: Source, names: Sequence[str], axes: Sequence[str], unit: float | None
) -> list[tuple[ArrayLike, str, Mapping[str, object], float]]:
    """The arrays of a vector field with the meaning of their axes, their attributes and their units in SI."""
    return [
        (source.arrays[name], letters, source.attributes.get(name, {}), unit or _stated(source, name))
        for name, letters in zip(names, axes, strict=True)
    ]


def _stated(source: Source, name: str) -> float:
    """m/s per unit, from the array's attribute `units`; 1 where there is none."""
    units = source.attributes.get(name, {}).get("units")
    if units is None or str(units).strip() == "":
        return 1.0
    try:
        return factor(units.decode() if isinstance(units, bytes) else str(units), "velocity")
    except ValueError as fault:
        raise FormatError(f"{source.path}: {name}: its attribute units: {fault} (--velocity-unit)") from fault


def _scalar(
    source: Source,
    said: FieldMap,
    name: str,
    lie: Orientation,
    whole: tuple[int, tuple[int, ...]],
    meaning: tuple[type, Callable[[np.ndarray], np.ndarray]],
) -> np.ndarray | None:
    """A scalar field, (T, *grid), for frames and nodes along i, j, k, of a type and made of what is stored."""
    if not name:
        return None
    letters, (frames, counts), (kind, made) = _axes(source, said, name, False), whole, meaning
    size = dict(zip(letters, source.arrays[name].shape, strict=True))
    if tuple(size.get(letter, 0) for letter in "xyz"[: len(counts)]) != counts or size.get("c", 1) != 1:
        raise FormatError(
            f"{source.path}: {name} has the shape {source.arrays[name].shape} ({letters}), the velocity has {counts} "
            "nodes (x, y, z)"
        )
    if size.get("t", 1) not in (1, frames):
        raise FormatError(f"{source.path}: {name} has {size['t']} frames, the velocity {frames}")
    result: np.ndarray = np.empty((frames, *(counts[lie.order[axis]] for axis in reversed(range(len(counts))))), kind)
    fill_scalar(result, source.arrays[name], letters, source.attributes.get(name, {}), lie, made)
    return result


def _time(source: Source, said: FieldMap, frames: int) -> np.ndarray:
    unit = said.unit("time") or 1.0
    time: np.ndarray
    if isinstance(said.time, tuple) and said.time:
        time = np.asarray(said.time, np.float64) * unit
    elif said.time:
        name = str(said.time)
        if name not in source.arrays:
            raise FormatError(f"{source.path}: has no array {name} of times")
        time = np.asarray(source.arrays[name][(...,)], np.float64).reshape(-1) * unit
    elif said.interval is not None:
        time = said.interval * np.arange(frames)
    elif source.time is not None:
        time = np.asarray(source.time, np.float64) * (unit if said.time_unit else 1.0)
    elif said.period > 0:
        time = said.period * np.arange(frames) / frames
    elif frames == 1:
        time = np.zeros(1)
    else:
        raise FormatError(
            f"{source.path}: when were its {frames} frames? Say it (--interval S, --period S or --time NAME)"
        )
    if len(time) != frames:
        raise FormatError(f"{source.path}: {len(time)} times for {frames} frames")
    return time


def _notes(source: Source, said: FieldMap, lie: Orientation, unit: float | None) -> list[str]:
    notes = []
    if (lie.turn != np.eye(len(lie.order))).any():
        rows = "; ".join(", ".join(f"{value:.6g}" for value in row) for row in lie.turn)
        notes.append(f"axes of the image kept; file coordinates = [{rows}] @ recorded ones")
    if source.world in MIRROR:
        notes.append("coordinates are LPS, as of DICOM")
    return notes
