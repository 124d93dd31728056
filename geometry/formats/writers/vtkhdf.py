"""VTKHDF by h5py alone: the grid's fields, the moving wall and particles, each as one temporal file.

The layout is that of version 2 of the format ("VTKHDF file format", VTK documentation): image data with time
as the first axis, polygonal data with the parts of all times in a row.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import h5py
import numpy as np

from geometry.formats.own.mark import MARK, marked
from geometry.recordings.recording import Recording
from geometry.recordings.whole_file import write_whole

from .common import SCALARS, VECTORS, lattice, scalar, vector, wall_velocity

TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")


def write_vtkhdf(path: Path, recording: Recording) -> list[Path]:
    """The fields of the grid to `path`, the wall beside it as `NAME_wall.vtkhdf`."""
    with in_memory(path) as file:
        points = image_data(file, recording)
        for name in VECTORS:
            field = vector(recording, name)
            if field is not None:
                _store(points, name, np.moveaxis(field, 1, -1), recording.dimension)
        for name in SCALARS:
            values = scalar(recording, name)
            if values is not None:
                _store(points, name, values, recording.dimension)
        time_steps(file["VTKHDF"], recording.time, list(points))
        file[MARK] = marked(recording)  # beside what viewers look at
    return [path, *_wall(path, recording)]


@contextmanager
def in_memory(path: Path) -> Iterator[h5py.File]:
    """A file that is made in memory and written whole: HDF5 does not survive a disk that is full."""
    with h5py.File(f"{path} in memory", "w", driver="core", backing_store=False) as file:
        yield file
        file.flush()
        image = file.id.get_file_image()
    write_whole(path, image)


class PolySeries:
    """A temporal file of polygonal data (walls, particles) that grows by one time after the other, in memory."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._file = h5py.File(f"{self.path} in memory", "w", driver="core", backing_store=False)
        root = self._file.create_group("VTKHDF")
        root.attrs["Version"] = np.array([2, 0], np.int64)
        root.attrs.create("Type", np.bytes_("PolyData"))
        self._root, self._steps = root, root.create_group("Steps")
        self._count = self._parts = self._nodes = 0
        self._cells: np.ndarray | None = None
        self._starts: dict[str, list[int]] = {}

    def __enter__(self) -> PolySeries:
        return self

    def __exit__(self, kind: type | None, fault: BaseException | None, trace: TracebackType | None) -> None:
        if fault is None:
            self.close()
        else:
            self._file.close()

    def close(self) -> None:
        """Write the file, which nobody sees before."""
        self._steps.attrs["NSteps"] = np.int64(self._count)
        self._file.flush()
        image = self._file.id.get_file_image()
        self._file.close()
        write_whole(self.path, image)

    def append(
        self,
        time: float,
        points: np.ndarray,
        cells: np.ndarray | None = None,
        *,
        point_data: Mapping[str, np.ndarray] | None = None,
        cell_data: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Add the state at a time.

        Args:
            time: s.
            points: (n, D), m.
            cells: (m, 3) triangles or (m, 2) lines of point numbers; None makes a vertex of every point.
            point_data: by name, (n, ...); the same names at every time.
            cell_data: by name, (m, ...); the same names at every time.
        """
        place = np.zeros((len(points), 3))
        place[:, : points.shape[1]] = points
        cells = np.arange(len(points))[:, None] if cells is None else np.asarray(cells)
        if self._cells is None or not (len(points) == self._nodes and np.array_equal(cells, self._cells)):
            self._new_part(cells, len(points))
        _grow(self._steps, "Values", np.array([time]))
        _grow(self._steps, "PartOffsets", np.array([self._parts - 1], np.int64))
        _grow(self._steps, "NumberOfParts", np.array([1], np.int64))
        _grow(self._steps, "PointOffsets", np.array([self._length("Points")], np.int64))
        for name in ("CellOffsets", "ConnectivityIdOffsets"):
            _grow(self._steps, name, np.array([self._starts[name]], np.int64))
        _grow(self._root, "Points", place)
        for group, data in (("PointData", point_data), ("CellData", cell_data)):
            for name, values in (data or {}).items():
                values = _three(np.asarray(values))
                _grow(self._steps, f"{group}Offsets/{name}", np.array([self._length(f"{group}/{name}")], np.int64))
                _grow(self._root, f"{group}/{name}", values)
        self._count += 1

    def _new_part(self, cells: np.ndarray, nodes: int) -> None:
        """Store cells that differ from those of the time before; times of the same cells share them."""
        kind = {1: "Vertices", 2: "Lines", 3: "Polygons"}[cells.shape[1]]
        # A part has one offset more than cells, which the reader adds by itself.
        self._starts = {
            "CellOffsets": [self._length(f"{name}/Offsets") - self._parts for name in TOPOLOGIES],
            "ConnectivityIdOffsets": [self._length(f"{name}/Connectivity") for name in TOPOLOGIES],
        }
        _grow(self._root, "NumberOfPoints", np.array([nodes], np.int64))
        for name in TOPOLOGIES:
            chosen = cells if name == kind else cells[:0]
            _grow(self._root, f"{name}/NumberOfCells", np.array([len(chosen)], np.int64))
            _grow(self._root, f"{name}/NumberOfConnectivityIds", np.array([chosen.size], np.int64))
            _grow(self._root, f"{name}/Offsets", cells.shape[1] * np.arange(len(chosen) + 1, dtype=np.int64))
            _grow(self._root, f"{name}/Connectivity", chosen.ravel().astype(np.int64))
        self._cells, self._nodes = cells.copy(), nodes
        self._parts += 1

    def _length(self, name: str) -> int:
        return len(self._root[name]) if name in self._root else 0


def _three(values: np.ndarray) -> np.ndarray:
    """Vectors of a plane with a third component of 0."""
    if values.ndim == 2 and values.shape[1] == 2:
        return np.concatenate([values, np.zeros_like(values[:, :1])], axis=1)
    return values


def _grow(group: h5py.Group, name: str, values: np.ndarray) -> None:
    if name not in group:
        chunk = (max(1, min(len(values) or 1, 65536)), *values.shape[1:])
        options = {"compression": "gzip", "shuffle": True} if len(values) > 16 else {}
        group.create_dataset(name, data=values, maxshape=(None, *values.shape[1:]), chunks=chunk, **options)
        return
    node = group[name]
    node.resize(len(node) + len(values), axis=0)
    if len(values):
        node[-len(values) :] = values


def image_data(file: h5py.File, recording: Recording) -> h5py.Group:
    """The head of an image file: its lattice; what is returned holds the fields."""
    origin, spacing, counts = lattice(recording)
    root = file.create_group("VTKHDF")
    root.attrs["Version"] = np.array([2, 0], np.int64)
    root.attrs.create("Type", np.bytes_("ImageData"))
    root.attrs["WholeExtent"] = np.array([edge for count in counts for edge in (0, count - 1)], np.int64)
    root.attrs["Origin"], root.attrs["Spacing"] = origin, spacing
    root.attrs["Direction"] = np.eye(3).ravel()
    return root.create_group("PointData")


def time_steps(root: h5py.Group, time: np.ndarray, names: list[str]) -> None:
    """The times of an image file whose fields of those names have one entry for each."""
    if len(time) == 1:
        root.create_group("FieldData")["TimeValue"] = np.asarray(time, np.float64)
        return
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(len(time))
    steps["Values"] = np.asarray(time, np.float64)
    offsets = steps.create_group("PointDataOffsets")
    for name in names:
        offsets[name] = np.arange(len(time), dtype=np.int64)


def _store(points: h5py.Group, name: str, values: np.ndarray, dimension: int) -> None:
    """One chunk a frame, compressed; VTK wants a plane's arrays without the axis of its single layer."""
    values = values[:, 0] if dimension == 2 else values
    chunk = (1, *values.shape[1:])
    if len(values) == 1:  # a single time has no axis of times in VTK's eyes
        values, chunk = values[0], values.shape[1:]
    points.create_dataset(name, data=values, chunks=chunk, compression="gzip", shuffle=True)


def _wall(path: Path, recording: Recording) -> list[Path]:
    if recording.wall is None:
        return []
    wall, beside = recording.wall, path.with_name(f"{path.stem}_wall.vtkhdf")
    velocity = wall_velocity(wall, recording.time)
    with PolySeries(beside) as series:
        for frame, time in enumerate(recording.time.tolist()):
            surface = wall.at(frame)
            series.append(
                time,
                surface.vertices,
                wall.faces,
                point_data={"velocity": velocity[frame]},
                cell_data={"region": wall.region},
            )
    return [beside]
