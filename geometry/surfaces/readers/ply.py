"""PLY files, ASCII and binary, with polygons of any size and properties of each face.

Read here because trimesh 5.2 refuses binary files that mix triangles and quadrilaterals and reorders the faces
of ASCII ones, so that their properties no longer belong to them; vtk drops the properties.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .polygons import PolygonError, Polygons

TYPES = {
    name: kind
    for kind, names in {
        "i1": ("char", "int8"),
        "u1": ("uchar", "uint8"),
        "i2": ("short", "int16"),
        "u2": ("ushort", "uint16"),
        "i4": ("int", "int32"),
        "u4": ("uint", "uint32"),
        "f4": ("float", "float32"),
        "f8": ("double", "float64"),
    }.items()
    for name in names
}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
CORNERS = ("vertex_indices", "vertex_index")
LABELS = ("region", "label", "RegionId", "material_index", "segment")


@dataclass
class _Element:
    """One `element` of the header: its count and properties (name, type, type of the count or None)."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)


def read_ply(path: Path) -> Polygons:
    """The faces of a PLY file; a face property `region` (or `label`, ...) gives the regions.

    Raises:
        PolygonError: no PLY file, or one that ends too early.
    """
    data = path.read_bytes()
    elements, order, body = _header(data)
    read = _ascii if order == "" else _binary
    found = read(elements, body, order)
    vertex, face = found.get("vertex"), found.get("face")
    if vertex is None or not {"x", "y", "z"} <= set(vertex):
        raise PolygonError("holds no vertices with x, y and z")
    lists = next((face[name] for name in CORNERS if name in face), None) if face else None
    if face is None or lists is None:
        raise PolygonError("holds no triangles")
    sizes = np.array([len(one) for one in lists], np.int64)
    corners = np.concatenate([np.asarray(one, np.int64) for one in lists]) if len(lists) else np.zeros(0, np.int64)
    points = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    region = next((np.asarray(face[name]) for name in LABELS if name in face), None)
    return Polygons(points, corners, sizes, region)


def _header(data: bytes) -> tuple[list[_Element], str, bytes]:
    """The elements, the byte order ("" for ASCII) and what follows the header."""
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise PolygonError("is no PLY file: it has no header from 'ply' to 'end_header'")
    elements: list[_Element] = []
    order = None
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        try:
            match words:
                case ["format", name, _]:
                    order = ORDERS[name]
                case ["element", name, count]:
                    elements.append(_Element(name, int(count)))
                case ["property", "list", length, kind, name]:
                    elements[-1].properties.append((name, TYPES[kind], TYPES[length]))
                case ["property", kind, name]:
                    elements[-1].properties.append((name, TYPES[kind], None))
        except (KeyError, ValueError, IndexError) as fault:
            raise PolygonError(f"its header line {line.strip()!r} cannot be read") from fault
    if order is None:
        raise PolygonError("its header names no format (ascii, binary_little_endian, binary_big_endian)")
    newline = data.find(b"\n", end)
    return elements, order, data[newline + 1 :]


def _ascii(elements: list[_Element], body: bytes, _: str) -> dict[str, dict[str, list]]:
    tokens, at = body.split(), 0
    found: dict[str, dict[str, list]] = {}
    for element in elements:
        columns: dict[str, list] = {name: [] for name, _, _ in element.properties}
        for _row in range(element.count):
            for name, kind, length in element.properties:
                many = 1 if length is None else int(tokens[at]) if at < len(tokens) else 0
                at += length is not None
                words = tokens[at : at + many]
                if len(words) < many or at > len(tokens):
                    raise PolygonError(f"ends within its element {element.name}")
                at += many
                number = float if kind[0] == "f" else int
                try:
                    values = [number(word) for word in words]
                except ValueError as fault:
                    raise PolygonError(f"holds a word that is no number ({fault})") from fault
                columns[name].append(values[0] if length is None else values)
        found[element.name] = columns
    return found


def _binary(elements: list[_Element], body: bytes, order: str) -> dict[str, dict[str, list | np.ndarray]]:
    found: dict[str, dict[str, list | np.ndarray]] = {}
    at = 0
    for element in elements:
        try:
            columns, at = _regular(element, body, at, order) or _irregular(element, body, at, order)
        except (ValueError, IndexError) as fault:
            raise PolygonError(f"ends within its element {element.name}") from fault
        found[element.name] = columns
    return found


def _regular(element: _Element, body: bytes, at: int, order: str) -> tuple[dict[str, list | np.ndarray], int] | None:
    """All rows at once, where every list is as long as in the first row; else None."""
    if element.count == 0:
        return {name: [] for name, _, _ in element.properties}, at
    lengths, place = [], at
    for _, kind, count in element.properties:
        many = 1 if count is None else int(np.frombuffer(body, order + count, 1, place)[0])
        place += many * np.dtype(kind).itemsize + (0 if count is None else np.dtype(count).itemsize)
        lengths.append(many)
    fields: list[tuple] = []
    for column, ((_, kind, count), many) in enumerate(zip(element.properties, lengths, strict=True)):
        if count is None:
            fields.append((f"v{column}", order + kind))
        else:
            fields += [(f"n{column}", order + count), (f"v{column}", order + kind, (many,))]
    dtype = np.dtype(fields)
    if len(body) - at < dtype.itemsize * element.count:
        return None
    rows = np.frombuffer(body, dtype, element.count, at)
    for column, many in enumerate(lengths):
        if element.properties[column][2] is not None and (rows[f"n{column}"] != many).any():
            return None
    values: dict[str, list | np.ndarray] = {
        name: rows[f"v{column}"] for column, (name, _, _) in enumerate(element.properties)
    }
    return values, at + dtype.itemsize * element.count


def _irregular(element: _Element, body: bytes, at: int, order: str) -> tuple[dict[str, list | np.ndarray], int]:
    """Row by row, where lists differ in length."""
    columns: dict[str, list] = {name: [] for name, _, _ in element.properties}
    for _ in range(element.count):
        for name, kind, count in element.properties:
            many = 1
            if count is not None:
                many = int(np.frombuffer(body, order + count, 1, at)[0])
                at += np.dtype(count).itemsize
            values = np.frombuffer(body, order + kind, many, at)
            at += many * np.dtype(kind).itemsize
            columns[name].append(values if count is not None else values[0])
    return dict(columns), at
