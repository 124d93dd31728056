"""OBJ files (Wavefront): vertices and faces, in whatever order they come.

Read here because trimesh counts negative indices from the end of the whole file; the format counts them from
the face's own line ("Object Files (.obj)", Advanced Visualizer manual, appendix B1, "Referencing groups of
vertices").
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from .polygons import PolygonError, Polygons


def read_obj(path: Path) -> Polygons:
    """The faces of an OBJ file; names of bodies from its `o` and `g` lines.

    Raises:
        PolygonError: a line is malformed; the text names its number.
    """
    vertices: list[tuple[float, float, float]] = []
    corners: list[int] = []
    sizes: list[int] = []
    names: list[str] = []
    name = ""
    with path.open(encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(_joined(lines), start=1):
            word, _, rest = line.strip().partition(" ")
            try:
                if word == "v":
                    x, y, z = rest.split()[:3]
                    vertices.append((float(x), float(y), float(z)))
                elif word in ("f", "fo"):
                    face = [_index(part, len(vertices)) for part in rest.split()]
                    corners += face
                    sizes.append(len(face))
                    names.append(name)
                elif word in ("o", "g"):
                    name = rest.strip()
            except ValueError as fault:
                raise PolygonError(f"line {number} cannot be read: {line.strip()[:60]!r} ({fault})") from fault
    points = np.array(vertices, np.float64).reshape(-1, 3)
    return Polygons(points, np.array(corners, np.int64), np.array(sizes, np.int64), names=names)


def _index(part: str, known: int) -> int:
    """The vertex number, from 0, of `7`, `7/1`, `7//3` or, counted back from this line, `-1`."""
    value = int(part.split("/", 1)[0])
    if value == 0:
        raise ValueError("vertices are counted from 1")
    if value < -known:
        raise ValueError(f"only {known} vertices stand above it")
    return value - 1 if value > 0 else known + value


def _joined(lines: Iterable[str]) -> Iterator[str]:
    """Lines with those that end in a backslash joined to the next; comments cut off."""
    held = ""
    for line in lines:
        text = held + line.split("#", 1)[0].rstrip()
        if text.endswith("\\"):
            held = text[:-1] + " "
            continue
        held = ""
        yield text.replace("\t", " ")
    if held:
        yield held
