"""Plane vectors as text: DaVis and OpenPIV."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.formats.source import FormatError, Source
from geometry.recordings.units import factor

from .tables import tables

MOST_LINES = 1 << 16  # columns or rows of a plane; more are points that lie on no grid
HEADER = re.compile(r'#DaVis.*?\s(\d+)\s+(\d+)\s+"([^"]*)"\s+"([^"]*)"\s+"[^"]*"\s+"[^"]*"\s+"([^"]*)"\s+"([^"]*)"')


@dataclass(frozen=True, eq=False)
class TextGrid:
    """The grid that the points of a text file lie on: places of its columns and rows, in the file's unit."""

    path: Path
    columns: np.ndarray
    rows: np.ndarray

    @classmethod
    def of(cls, path: Path) -> TextGrid:
        """By one passage through the file.

        Raises:
            FormatError: its points are no grid.
        """
        columns, rows, count = np.zeros(0), np.zeros(0), 0
        for part in tables(path, least=4):
            columns = np.union1d(columns, part[:, 0].round(6))
            rows = np.union1d(rows, part[:, 1].round(6))
            count += len(part)
            if len(columns) > MOST_LINES or len(rows) > MOST_LINES:
                break
        if len(columns) * len(rows) != count or len(columns) < 2 or len(rows) < 2:
            raise FormatError(f"{path}: its {count} points are no grid of {len(columns)} x {len(rows)}")
        return cls(path, columns, rows)


class TextField:
    """A component, or where there are vectors, indexed [y, x]; read when asked for and not kept after the last row."""

    def __init__(self, grid: TextGrid, name: str, zero_is_none: bool) -> None:
        self._grid, self._name, self._zero_is_none = grid, name, zero_is_none
        self.shape = (len(grid.rows), len(grid.columns))
        self.dtype = np.dtype(bool if name == "mask" else np.float32)
        self._values: np.ndarray | None = None

    def __getitem__(self, index: tuple) -> np.ndarray:
        if self._values is None:
            self._values = self._read()
        found = self._values[index].copy()
        if isinstance(index[0], slice) and index[0].stop == self.shape[0]:
            self._values = None
        return found

    def _read(self) -> np.ndarray:
        values = np.zeros(self.shape, self.dtype)
        for part in tables(self._grid.path, least=4):
            x, y, u, v = part[:, :4].T
            place = np.searchsorted(self._grid.rows, y.round(6)), np.searchsorted(self._grid.columns, x.round(6))
            if self._name == "mask":
                missing = ((u == 0) & (v == 0)) if self._zero_is_none else np.zeros(len(u), bool)
                values[place] = ~missing & np.isfinite(u) & np.isfinite(v)
            else:
                values[place] = np.nan_to_num(u if self._name == "u" else v)
        return values


def open_piv(path: Path) -> Source:
    """Columns x, y, u, v (and more) on a regular grid, with decimal points or commas.

    DaVis states units in its first line, and stores 0, 0 where it has no vector; OpenPIV is in pixels unless
    it was scaled, and marks faulty vectors in a column `flags`, `mask` or not at all.
    """
    with path.open(encoding="utf-8", errors="replace") as file:
        first = file.readline()
    lines = TextGrid.of(path)
    zero_is_none = first.startswith("#DaVis")
    fields = {name: TextField(lines, name, zero_is_none) for name in ("u", "v", "mask")}
    columns, rows = lines.columns, lines.rows
    length, unit = None, None
    found = HEADER.match(first)
    if found:
        length, unit = factor(found[4], "length"), _velocity(found[5], found[6], path)
    affine = np.diag([(columns[-1] - columns[0]) / (len(columns) - 1), (rows[-1] - rows[0]) / (len(rows) - 1), 1.0])
    affine[:2, 2] = columns[0], rows[0]
    roles = {"velocity": ("u", "v"), "mask": ("mask",)}
    return Source(
        str(path),
        fields,
        axes=dict.fromkeys(fields, "yx"),
        affine=affine,
        length=length,
        roles=roles,
        velocity_unit=unit,
    )


def _velocity(quantity: str, unit: str, path: Path) -> float:
    if quantity != "velocity":
        raise FormatError(f"{path}: its vectors are {quantity} in {unit}; say what they are in m/s (--velocity-unit)")
    return factor(unit, "velocity")
