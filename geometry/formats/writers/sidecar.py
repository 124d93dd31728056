"""VTKHDF beside a recording's file that shows its data without a copy, by HDF5's virtual datasets.

Links are relative: recording and sidecar are moved together, in whatever folder.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from geometry.arguments import checked
from geometry.formats.own.mark import SOURCE
from geometry.recordings.read import read_recording
from geometry.recordings.recording import Recording, Wall

from .common import SCALARS, VECTORS, wall_velocity
from .vtkhdf import TOPOLOGIES, image_data, in_memory, time_steps


@checked
def write_sidecar(recording_file: str | Path, recording: Recording | None = None) -> list[Path]:
    """VTKHDF files beside a recording's file, tens of kB, that viewers open in its place.

    Args:
        recording_file: a file that `write_recording` wrote; the sidecar must stay beside it.
        recording: what it holds, where that is at hand; else the file is read.

    Returns:
        The files written: `NAME.vtkhdf` for the fields, `NAME_wall.vtkhdf` for the wall.

    Raises:
        RecordingError: the file is no recording.
        OSError: the disk is full, or a link, device or folder has a name.
    """
    source = Path(recording_file)
    recording = read_recording(source) if recording is None else recording
    path = source.with_suffix(".vtkhdf")
    with in_memory(path) as file, h5py.File(source, "r") as original:
        points = image_data(file, recording)
        for name in (*VECTORS, *SCALARS):
            node = original.get(f"/{name}")
            if node is not None:
                _virtual(points, name, node, recording, source.name)
        time_steps(file["VTKHDF"], recording.time, list(points))
        file.attrs[SOURCE] = source.name
    if recording.wall is None:
        return [path]
    beside = path.with_name(f"{path.stem}_wall.vtkhdf")
    with in_memory(beside) as file, h5py.File(source, "r") as original:
        _wall(file.create_group("VTKHDF"), original, recording, recording.wall, source.name)
    return [path, beside]


def _virtual(points: h5py.Group, name: str, node: h5py.Dataset, recording: Recording, file: str) -> None:
    """A view of a dataset of the recording in the order that VTK wants: components last."""
    shape, is_vector = (recording.frames, *recording.grid.shape), name in VECTORS
    source = h5py.VirtualSource(file, f"/{name}", shape=node.shape, dtype=node.dtype)
    still = node.ndim == recording.dimension + is_vector
    layout = h5py.VirtualLayout((*shape, 3) if is_vector else shape, node.dtype)
    if recording.frames == 1:  # a single time has no axis of times in VTK's eyes
        layout = h5py.VirtualLayout(layout.shape[1:], node.dtype)
        whole = () if still else (0,)
        if not is_vector:
            layout[...] = source[(*whole, ...)]
        for component in range(recording.dimension if is_vector else 0):
            layout[..., component] = source[(*whole, component)]
        points.create_virtual_dataset(name, layout, fillvalue=0)
        return
    for frame in range(recording.frames) if still else [slice(None)]:
        if not is_vector:
            layout[frame] = source if still else source[...]
            continue
        for component in range(recording.dimension):
            layout[(frame, ..., component)] = source[component] if still else source[:, component]
    points.create_virtual_dataset(name, layout, fillvalue=0)


def _wall(root: h5py.Group, original: h5py.File, recording: Recording, wall: Wall, source: str) -> None:
    """One part, whose faces all times share and whose vertices are those of the recording."""
    frames, nodes, size = recording.frames, wall.vertices.shape[-2], wall.faces.shape[1]
    root.attrs["Version"] = np.array([2, 0], np.int64)
    root.attrs.create("Type", np.bytes_("PolyData"))
    root["NumberOfPoints"] = np.array([nodes], np.int64)
    _view(root, "Points", original["/wall/vertices"], source)
    kind = "Polygons" if size == 3 else "Lines"
    for name in TOPOLOGIES:
        faces = wall.faces if name == kind else wall.faces[:0]
        group = root.create_group(name)
        group["NumberOfCells"] = np.array([len(faces)], np.int64)
        group["NumberOfConnectivityIds"] = np.array([faces.size], np.int64)
        _packed(group, "Offsets", size * np.arange(len(faces) + 1, dtype=np.int64))
        _packed(group, "Connectivity", faces.ravel().astype(np.int64))
    _packed(root.create_group("CellData"), "region", wall.region)
    stored, points = original.get("/wall/velocity"), root.create_group("PointData")
    if stored is not None:
        _view(points, "velocity", stored, source)
    else:
        speed = wall_velocity(wall, recording.time)
        flat = np.zeros((*speed.shape[:-1], 3 - recording.dimension), speed.dtype)
        _packed(points, "velocity", np.concatenate([speed, flat], axis=-1).reshape(-1, 3))
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = np.int64(frames)
    steps["Values"] = np.asarray(recording.time, np.float64)
    steps["PartOffsets"], steps["NumberOfParts"] = np.zeros(frames, np.int64), np.ones(frames, np.int64)
    steps["PointOffsets"] = np.arange(frames) * (nodes if wall.moves else 0)
    for name in ("CellOffsets", "ConnectivityIdOffsets"):
        steps[name] = np.zeros((frames, len(TOPOLOGIES)), np.int64)
    steps["PointDataOffsets/velocity"] = np.arange(frames) * nodes
    steps["CellDataOffsets/region"] = np.zeros(frames, np.int64)


def _view(group: h5py.Group, name: str, node: h5py.Dataset, source: str) -> None:
    """(T * n, 3): the vectors (T, n, D) or (n, D) of the recording in a row, a plane's third component 0."""
    frames, nodes, dimension = (1, *node.shape) if node.ndim == 2 else node.shape
    layout = h5py.VirtualLayout((frames * nodes, 3), node.dtype)
    whole = h5py.VirtualSource(source, node.name, shape=node.shape, dtype=node.dtype)
    for frame in range(frames):
        rows = whole if node.ndim == 2 else whole[frame]
        layout[frame * nodes : (frame + 1) * nodes, :dimension] = rows
    group.create_virtual_dataset(name, layout, fillvalue=0)


def _packed(group: h5py.Group, name: str, values: np.ndarray) -> None:
    packed = {"compression": "gzip", "shuffle": True} if values.size > 16 else {}
    group.create_dataset(name, data=values, **packed)
