"""Numbers in columns of text, some lines at a time."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from geometry.formats.source import FormatError

LINES = 1024  # at a time


def tables(path: Path, *, least: int = 1) -> Iterator[np.ndarray]:
    """The rows of a text file, (n, columns) some at a time.

    Lines that begin with a letter, # or % are no data. Commas are decimal where columns are parted by tabs or blanks.

    Args:
        path: of the file.
        least: columns that there must be.

    Raises:
        FormatError: a word is no number, rows differ in length or there is none.
    """
    columns, number = 0, 0
    with path.open(encoding="utf-8", errors="replace") as file:
        while lines := list(islice(file, LINES)):
            texts = [(number + place, _plain(line)) for place, line in enumerate(lines, start=1) if _is_data(line)]
            number += len(lines)
            if not texts:
                continue
            columns = columns or len(texts[0][1].split())
            yield _rows(path, texts, max(columns, least))
    if columns == 0:
        raise FormatError(f"{path}: holds no row of numbers")


def _is_data(line: str) -> bool:
    bare = line.strip()
    return bool(bare) and bare[0] not in "#%" and not bare[0].isalpha()


def _plain(line: str) -> str:
    return line.replace(",", ".") if "\t" in line or " " in line.strip() else line.replace(",", " ")


def _rows(path: Path, texts: list[tuple[int, str]], columns: int) -> np.ndarray:
    """Numbered lines as rows of numbers."""
    for number, text in texts:
        found = len(text.split())
        if found != columns:
            raise FormatError(
                f"{path}: line {number} has {found} columns; must hold rows of at least x, y, u, v, all of one length"
            )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of words that are no numbers: told below
        values = np.fromstring(" ".join(text for _, text in texts), sep=" ")
    if values.size != columns * len(texts):
        number, text = texts[min(values.size // columns, len(texts) - 1)]
        raise FormatError(f"{path}: line {number} holds a word that is no number: {text.strip()[:60]!r}")
    return values.reshape(-1, columns)
