"""The compiled kernels: the library that fits this processor, and its functions through ctypes."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from regularize.native import loader
from regularize.native.faults import raise_faults
from regularize.native.loader import FORCED, PREFERENCE, LibraryMissing

from . import build, structures
from .structures import (
    BoxArguments,
    ClosestArguments,
    CorrelationArguments,
    GriddingArguments,
    ImageArguments,
    InterpolationArguments,
    ListArguments,
    LookUpArguments,
    PassArguments,
    PoissonArguments,
    SearchArguments,
    Sizes,
    WallArguments,
)

__all__ = ["FORCED", "PREFERENCE", "REALS", "Library", "LibraryMissing", "address", "family", "library"]

# what is compiled, and how its functions' names end
REALS = {torch.float32: "f32", torch.float64: "f64"}

_CURE = "use a larger spacing, or fewer members"

_int, _long, _real = ctypes.c_int32, ctypes.c_int64, ctypes.c_double


def address(tensor: Tensor | None) -> int | None:
    """Where a tensor's numbers begin; null for None."""
    return None if tensor is None else tensor.data_ptr()


@dataclass(frozen=True)
class Library(loader.Loaded):
    """The loaded library."""

    def function(self, name: str, reals: str) -> Any:
        """``name`` in the precision ``reals``: "f32" or "f64"."""
        return getattr(self.handle, f"sph_{name}_{reals}")


def family() -> loader.Family:
    """The libraries that ``build`` makes."""
    return loader.Family(build.LIBRARIES, build.STEM, "sph_runs", "torchsph.native.build")


@lru_cache(maxsize=1)
def library() -> Library:
    """The library for the best instruction set of this processor, or for the one that ``TORCHSPH_ISA`` names.

    Raises:
        LibraryMissing: nothing was compiled, what was is older than this code, or the forced instruction set is
            unknown or not here.
    """
    found = loader.choose(family())
    # a library that reads the fields of its arguments elsewhere would crash, or worse, go on
    if exported_layouts(found.handle) != structures.layouts() or not hasattr(found.handle, "sph_fault"):
        raise LibraryMissing(loader.outdated(family(), found.instruction_set))
    return Library(found.instruction_set, _declare(found.handle))


class _Layout(ctypes.Structure):
    """sph_layout of csrc/interface.h."""

    _fields_ = [
        ("structure", ctypes.c_char_p),
        ("field", ctypes.c_char_p),
        ("offset", _long),
        ("size", _long),
    ]


def exported_layouts(handle: ctypes.CDLL) -> list[tuple[str, str, int, int]]:
    """As ``structures.layouts``, by the library's own account; nothing from one that is too old to tell."""
    count = _long()
    tell = getattr(handle, "sph_layouts", None)
    if tell is None:
        return []
    tell.restype = ctypes.POINTER(_Layout)
    rows = tell(ctypes.byref(count))
    return [(row.structure.decode(), row.field.decode(), row.offset, row.size) for row in rows[: count.value]]


def _declare(handle: ctypes.CDLL) -> ctypes.CDLL:
    search, none = ctypes.POINTER(SearchArguments), None
    guarded = {"sph_grid_closest": _CURE}
    for reals in REALS.values():
        for name, arguments, result in (
            ("sort", (search, ctypes.POINTER(Sizes)), ctypes.c_int),
            ("list", (search, _long, ctypes.POINTER(ListArguments)), _long),
            ("pass", (ctypes.POINTER(PassArguments),), ctypes.c_int),
            ("poisson", (ctypes.POINTER(PoissonArguments),), ctypes.c_int),
            ("interpolate", (ctypes.POINTER(InterpolationArguments),), _long),
            ("look_up", (ctypes.POINTER(LookUpArguments),), none),
            ("wall_rates", (ctypes.POINTER(WallArguments),), none),
            ("wall_forces", (ctypes.POINTER(WallArguments),), none),
            ("wall_near", (ctypes.POINTER(WallArguments),), _long),
            ("correlate", (ctypes.POINTER(CorrelationArguments),), none),
            ("arrange", (ctypes.POINTER(ImageArguments),), none),
            ("box_sums", (ctypes.POINTER(BoxArguments),), none),
            ("spread", (ctypes.POINTER(GriddingArguments),), none),
            ("gather", (ctypes.POINTER(GriddingArguments),), none),
        ):
            function = getattr(handle, f"sph_{name}_{reals}")
            function.argtypes, function.restype = arguments, result
            guarded[f"sph_{name}_{reals}"] = _CURE
    handle.sph_grid_closest.argtypes, handle.sph_grid_closest.restype = [ctypes.POINTER(ClosestArguments)], None
    handle.sph_fma.argtypes, handle.sph_fma.restype = [_int, _long, ctypes.c_float], _real
    raise_faults(handle, "sph_fault", guarded)
    return handle
