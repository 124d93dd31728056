"""Plane vectors as text: DaVis and OpenPIV."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from geometry.formats.source import FormatError, Source
from geometry.recordings.units import factor

HEADER = re.compile(r'#DaVis.*?\s(\d+)\s+(\d+)\s+"([^"]*)"\s+"([^"]*)"\s+"[^"]*"\s+"[^"]*"\s+"([^"]*)"\s+"([^"]*)"')


def open_piv(path: Path) -> Source:
    """Columns x, y, u, v (and more) on a regular grid, with decimal points or commas.

    DaVis states units in its first line, and stores 0, 0 where it has no vector; OpenPIV is in pixels unless
    it was scaled, and marks faulty vectors in a column `flags`, `mask` or not at all.
    """
    first = path.read_text(encoding="utf-8", errors="replace").split("\n", 1)[0]
    rows = _rows(path)
    x, y, u, v = rows[:, :4].T
    columns, lines = np.unique(x.round(6)), np.unique(y.round(6))
    if len(columns) * len(lines) != len(rows) or len(columns) < 2 or len(lines) < 2:
        raise FormatError(f"{path}: its {len(rows)} points are no grid of {len(columns)} x {len(lines)}")
    place = np.searchsorted(lines, y.round(6)), np.searchsorted(columns, x.round(6))
    fields = {}
    missing = ((u == 0) & (v == 0)) if first.startswith("#DaVis") else np.zeros(len(u), bool)
    for name, values in (("u", u), ("v", v), ("mask", ~missing & np.isfinite(u) & np.isfinite(v))):
        grid = np.zeros((len(lines), len(columns)))
        grid[place] = np.nan_to_num(values)
        fields[name] = grid
    length, unit = None, None
    found = HEADER.match(first)
    if found:
        length, unit = factor(found[4], "length"), _velocity(found[5], found[6], path)
    affine = np.diag([(columns[-1] - columns[0]) / (len(columns) - 1), (lines[-1] - lines[0]) / (len(lines) - 1), 1.0])
    affine[:2, 2] = columns[0], lines[0]
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


def _rows(path: Path) -> np.ndarray:
    """Numbers of all lines that are no comments; commas are decimal where columns are parted by tabs or blanks."""
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        if not line.strip() or line.lstrip()[0] in "#%" or line.lstrip()[0].isalpha():
            continue
        text = line.replace(",", ".") if "\t" in line or " " in line.strip() else line.replace(",", " ")
        try:
            rows.append([float(word) for word in text.split()])
        except ValueError as fault:
            raise FormatError(f"{path}: line {number} holds a word that is no number: {line.strip()[:60]!r}") from fault
    if not rows or len({len(row) for row in rows}) > 1 or len(rows[0]) < 4:
        raise FormatError(f"{path}: must hold rows of at least x, y, u, v, all of one length")
    return np.array(rows)
