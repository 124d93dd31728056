"""What a file of a lab says, before any of its arrays is read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from geometry.recordings.errors import RecordingError
from geometry.surfaces.surface import SurfaceError


class FormatError(ValueError):
    """A file that cannot be converted; the text names it, the rule broken and what to do."""


def refuse_streams(paths: Iterable[Path]) -> None:
    """Refuse what would be waited for, or never ends.

    Raises:
        FormatError: a device, a pipe or a socket; folders are some formats' own.
    """
    for path in paths:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise FormatError(f"{path}: is a device, a pipe or a socket; name a file")


@contextmanager
def understood(path: object) -> Iterator[None]:
    """The boundary around the readers of many packages: whatever they raise names the file.

    Raises:
        FormatError: they stumbled over the file.
    """
    try:
        yield
    except (FormatError, RecordingError, SurfaceError, MemoryError):
        raise
    except OSError as fault:
        if fault.errno is not None or type(fault) is not OSError:  # h5py's name neither file nor number
            raise
        raise _stumbled(path, fault) from fault
    except Exception as fault:
        raise _stumbled(path, fault) from fault


def _stumbled(path: object, fault: Exception) -> FormatError:
    said = " ".join(str(fault).split())[:200]
    kind = type(fault).__name__
    return FormatError(
        f"{path}: is damaged, or not what its name or the options say ({kind}{': ' if said else ''}{said}); write or "
        "copy it again, or name its format (--format)"
    )


class ArrayLike(Protocol):
    """An array whose shape is known before its values are read."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of its axes."""
        ...

    @property
    def dtype(self) -> np.dtype:
        """Type of its values."""
        ...

    def __getitem__(self, index: tuple) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class Source:
    """The arrays of a file, and what it says of their places, times and units.

    Attributes:
        path: of the file, for messages.
        arrays: by name; none of them has been read where the format allows that.
        attributes: of each array, as `units`, `scale_factor`, `add_offset`, `_FillValue`.
        axes: what the axes of each array mean, in array order: a letter of `t`, `c`, `x`, `y`, `z` for each
            (x, y, z are the image's own axes i, j, k); "" where the file does not say.
        affine: (D+1, D+1), from node numbers (i, j, k) to places, or None where the file does not say.
        length: metres per unit of the affine's places, or None.
        world: "ras" or "lps" for coordinates of a patient, "" for any others.
        time: (T,), s, or None.
        roles: which arrays are meant as `velocity`, `mask`, ..., as far as the file says.
        velocity_unit: m/s per unit of the velocity, as far as the file says.
        close: to be called when nothing more is read.
    """

    path: str
    arrays: Mapping[str, ArrayLike]
    attributes: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    axes: Mapping[str, str] = field(default_factory=dict)
    affine: np.ndarray | None = None
    length: float | None = None
    world: str = ""
    time: np.ndarray | None = None
    roles: Mapping[str, Sequence[str]] = field(default_factory=dict)
    velocity_unit: float | None = None
    close: Callable[[], None] = lambda: None


def diagonal(spacing: Sequence[float], origin: Sequence[float]) -> np.ndarray:
    """The affine of axes that are not turned."""
    affine = np.diag([*spacing, 1.0]).astype(np.float64)
    affine[:-1, -1] = origin
    return affine


def missing_extra(path: object, package: str) -> FormatError:
    """The refusal of a file whose reader is not installed."""
    return FormatError(f'{path}: needs the package {package}: python -m pip install "torchsph[formats]"')
