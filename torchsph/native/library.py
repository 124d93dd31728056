"""The compiled pair kernels: which library fits this processor, and its C interface through ctypes."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from . import build

PREFERENCE = ("avx512", "avx2", "baseline")
FORCED = "TORCHSPH_ISA"
# what is compiled, and how its functions' names end
REALS = {torch.float32: "f32", torch.float64: "f64"}

_pointer, _int, _long, _real = ctypes.c_void_p, ctypes.c_int32, ctypes.c_int64, ctypes.c_double


def address(tensor: Tensor | None) -> int | None:
    """Where a tensor's numbers begin; null for None."""
    return None if tensor is None else tensor.data_ptr()


class SearchArguments(ctypes.Structure):
    """sph_search of csrc/interface.h."""

    _fields_ = [
        ("particles", _long),
        ("position", _pointer),
        ("member", _pointer),
        ("radius", _real),
        ("period", _real * 3),
        ("dimension", _int),
        ("threads", _int),
    ]


class Sizes(ctypes.Structure):
    """sph_sizes of csrc/interface.h."""

    _fields_ = [("clusters", _long), ("members", _long), ("unusable", _long)]


class ListArguments(ctypes.Structure):
    """sph_lists of csrc/interface.h."""

    _fields_ = [(name, _pointer) for name in ("slot", "owner", "offset", "entries", "home")]


class PassArguments(ctypes.Structure):
    """sph_pass of csrc/interface.h."""

    _fields_ = [
        ("dimension", _int),
        ("threads", _int),
        ("terms", ctypes.c_uint32),
        ("weight", _int),
        ("form", _int),
        ("kernel", _int),
        ("support", _real),
        ("sigma", _real),
        ("particles", _long),
        ("clusters", _long),
        ("slot", _pointer),
        ("owner", _pointer),
        ("entries", _pointer),
        ("offset", _pointer),
        ("home", _pointer),
        ("period", _real * 3),
        ("coefficients", _pointer),
        ("position", _pointer),
        ("velocity", _pointer),
        ("mass", _pointer),
        ("deviation", _pointer),
        ("pressure", _pointer),
        ("slope", _pointer),
        ("field", _pointer),
        ("active", _pointer),
        ("divergence", _pointer),
        ("diffusion", _pointer),
        ("concentration", _pointer),
        ("xsph", _pointer),
        ("acceleration", _pointer),
        ("shepard_volume", _pointer),
        ("shepard_mass", _pointer),
        ("renormalisation", _pointer),
        ("laplacian", _pointer),
        ("diagonal", _pointer),
        ("gradient", _pointer),
        ("moment_first", _pointer),
        ("moment_second", _pointer),
        ("moment_mass", _pointer),
    ]


class PoissonArguments(ctypes.Structure):
    """sph_poisson of csrc/interface.h."""

    _fields_ = [
        ("pass_", PassArguments),
        ("source", _pointer),
        ("start", _pointer),
        ("free", _pointer),
        ("singular", _pointer),
        ("member", _pointer),
        ("members", _long),
        ("iterations", _long),
        ("tolerance", _real),
        ("values", _pointer),
        ("count", _pointer),
        ("residual", _pointer),
        ("mismatch", _pointer),
        ("converged", _pointer),
    ]


class InterpolationArguments(ctypes.Structure):
    """sph_interpolation of csrc/interface.h."""

    _fields_ = [
        ("particles", SearchArguments),
        ("fields", _pointer),
        ("columns", _long),
        ("queries", _long),
        ("query", _pointer),
        ("query_member", _pointer),
        ("kernel", _int),
        ("support", _real),
        ("sigma", _real),
        ("lengths", _pointer),
        ("count", _pointer),
        ("value", _pointer),
        ("first", _pointer),
        ("second", _pointer),
        ("field", _pointer),
        ("field_first", _pointer),
        ("weights", _pointer),
    ]


class ClosestArguments(ctypes.Structure):
    """sph_closest of csrc/interface.h."""

    _fields_ = [
        ("dimension", _int),
        ("threads", _int),
        ("faces", _long),
        ("vertices", _pointer),
        ("values", _pointer),
        ("corners", _pointer),
        ("origin", _real * 3),
        ("step", _real),
        ("counts", _long * 3),
        ("limit", _pointer),
        ("distance", _pointer),
        ("carried", _pointer),
    ]


class LookUpArguments(ctypes.Structure):
    """sph_look_up of csrc/interface.h."""

    _fields_ = [
        ("dimension", _int),
        ("threads", _int),
        ("channels", _long),
        ("count", _long),
        ("fractions", _long),
        ("early", _pointer),
        ("late", _pointer),
        ("plain", _pointer),
        ("points", _pointer),
        ("fraction", _pointer),
        ("origin", _real * 3),
        ("step", _real * 3),
        ("counts", _long * 3),
        ("unit", _int),
        ("out", _pointer),
    ]


class WallArguments(ctypes.Structure):
    """sph_walls of csrc/interface.h."""

    _fields_ = [
        ("dimension", _int),
        ("threads", _int),
        ("form", _int),
        ("count", _long),
        ("channels", _long),
        ("rows", _pointer),
        ("velocity", _pointer),
        ("divergence", _pointer),
        ("crowding", _pointer),
        ("whole_divergence", _pointer),
        ("whole_crowding", _pointer),
        ("pressure", _pointer),
        ("deviation", _pointer),
        ("viscosity", _pointer),
        ("viscosities", _long),
        ("member", _pointer),
        ("acceleration", _pointer),
        ("whole_acceleration", _pointer),
        ("smallest_share", _real),
        ("smallest_gap", _real),
        ("before", _pointer),
        ("after", _pointer),
        ("distance", _pointer),
        ("distance_stride", _long),
        ("step", _pointer),
        ("held", _pointer),
        ("gap", _real),
        ("near", _pointer),
        ("near_distance", _pointer),
    ]


@dataclass(frozen=True)
class Library:
    """A loaded library and the instruction set it was compiled for."""

    instruction_set: str
    handle: ctypes.CDLL

    def function(self, name: str, reals: str) -> ctypes._CFuncPtr:
        """``name`` in the precision ``reals``: "f32" or "f64"."""
        return getattr(self.handle, f"sph_{name}_{reals}")


class LibraryMissing(RuntimeError):
    """The compiled kernels cannot be used here; the message says why and what to do."""


@lru_cache(maxsize=1)
def library() -> Library:
    """The library for the best instruction set of this processor, or for the one that ``TORCHSPH_ISA`` names.

    Raises:
        LibraryMissing: nothing was compiled, or the forced instruction set is unknown or not here.
    """
    baseline = build.LIBRARIES / build.library_name("baseline")
    if not baseline.is_file():
        raise LibraryMissing(
            f"the compiled kernels are not in {build.LIBRARIES}: the install found no C++ compiler. Install "
            "g++ or clang++ and reinstall, or run 'python -m torchsph.native.build'"
        )
    runs = _load(baseline).sph_runs
    forced = os.environ.get(FORCED)
    if forced:
        if forced not in PREFERENCE:
            raise LibraryMissing(f"{FORCED}={forced} is unknown; known: {', '.join(PREFERENCE)}")
        if not runs(forced.encode()):
            raise LibraryMissing(f"{FORCED}={forced} asks for instructions that this processor lacks; unset it")
        return _choose((forced,))
    return _choose(tuple(isa for isa in PREFERENCE if runs(isa.encode())))


def _choose(candidates: tuple[str, ...]) -> Library:
    for isa in candidates:
        path = build.LIBRARIES / build.library_name(isa)
        if path.is_file():
            return Library(isa, _declare(_load(path)))
    raise LibraryMissing(
        f"no library for {', '.join(candidates)} in {build.LIBRARIES}; run 'python -m torchsph.native.build'"
    )


def _load(path: Path) -> ctypes.CDLL:
    try:
        return ctypes.CDLL(str(path))
    except OSError as problem:
        raise LibraryMissing(
            f"{path} cannot be loaded ({problem}); rebuild with 'python -m torchsph.native.build'"
        ) from problem


def _declare(handle: ctypes.CDLL) -> ctypes.CDLL:
    for reals in ("f32", "f64"):
        getattr(handle, f"sph_sort_{reals}").argtypes = [
            ctypes.POINTER(SearchArguments),
            ctypes.POINTER(Sizes),
        ]
        listing = getattr(handle, f"sph_list_{reals}")
        listing.argtypes = [ctypes.POINTER(SearchArguments), _long, ctypes.POINTER(ListArguments)]
        listing.restype = _long
        getattr(handle, f"sph_pass_{reals}").argtypes = [ctypes.POINTER(PassArguments)]
        getattr(handle, f"sph_poisson_{reals}").argtypes = [ctypes.POINTER(PoissonArguments)]
        look_up = getattr(handle, f"sph_look_up_{reals}")
        look_up.argtypes, look_up.restype = [ctypes.POINTER(LookUpArguments)], None
        for name, result in (("wall_rates", None), ("wall_forces", None), ("wall_near", _long)):
            part = getattr(handle, f"sph_{name}_{reals}")
            part.argtypes, part.restype = [ctypes.POINTER(WallArguments)], result
        interpolate = getattr(handle, f"sph_interpolate_{reals}")
        interpolate.argtypes, interpolate.restype = [ctypes.POINTER(InterpolationArguments)], _long
    handle.sph_grid_closest.argtypes, handle.sph_grid_closest.restype = [ctypes.POINTER(ClosestArguments)], None
    handle.sph_fma.argtypes, handle.sph_fma.restype = [_int, _long, ctypes.c_float], _real
    return handle
