"""What compiled code is called with: the structures of csrc/interface.h, field by field, through ctypes.

``headers`` writes from here what the library says of its own structures (csrc/layouts.hpp), and reads this file by its
path where there is no torch: it imports the standard library alone.
"""

from __future__ import annotations

import ctypes

_pointer, _int, _long, _real = ctypes.c_void_p, ctypes.c_int32, ctypes.c_int64, ctypes.c_double


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
        *((name, _pointer) for name in ("slot", "owner", "entries", "offset", "home")),
        ("period", _real * 3),
        *((name, _pointer) for name in ("coefficients", "position", "velocity", "mass", "deviation")),
        *((name, _pointer) for name in ("pressure", "slope", "field", "active", "outputs")),
    ]


class PoissonArguments(ctypes.Structure):
    """sph_poisson of csrc/interface.h."""

    _fields_ = [
        ("pass", PassArguments),
        *((name, _pointer) for name in ("source", "start", "free", "singular", "member")),
        ("members", _long),
        ("iterations", _long),
        ("tolerance", _real),
        *((name, _pointer) for name in ("values", "count", "residual", "mismatch", "converged")),
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
        *(
            (name, _pointer)
            for name in ("lengths", "count", "value", "first", "second", "field", "field_first", "weights")
        ),
    ]


class ClosestArguments(ctypes.Structure):
    """sph_closest of csrc/interface.h."""

    _fields_ = [
        ("dimension", _int),
        ("threads", _int),
        ("faces", _long),
        *((name, _pointer) for name in ("vertices", "values", "corners")),
        ("origin", _real * 3),
        ("step", _real),
        ("counts", _long * 3),
        *((name, _pointer) for name in ("limit", "distance", "carried")),
    ]


class LookUpArguments(ctypes.Structure):
    """sph_look_up of csrc/interface.h."""

    _fields_ = [
        ("dimension", _int),
        ("threads", _int),
        ("channels", _long),
        ("count", _long),
        ("fractions", _long),
        *((name, _pointer) for name in ("early", "late", "plain", "points", "fraction")),
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
        *(
            (name, _pointer)
            for name in (
                "rows",
                "velocity",
                "divergence",
                "concentration_gradient",
                "whole_divergence",
                "whole_concentration_gradient",
                "pressure",
                "deviation",
                "viscosity",
            )
        ),
        ("viscosities", _long),
        *((name, _pointer) for name in ("member", "acceleration", "whole_acceleration")),
        ("smallest_share", _real),
        ("smallest_gap", _real),
        *((name, _pointer) for name in ("before", "after", "distance")),
        ("distance_stride", _long),
        ("step", _pointer),
        ("held", _pointer),
        ("gap", _real),
        ("near", _pointer),
        ("near_distance", _pointer),
    ]


class CorrelationArguments(ctypes.Structure):
    """sph_correlation of csrc/interface.h."""

    _fields_ = [
        ("threads", _int),
        *((name, _long) for name in ("points", "images", "apart")),
        *((name, _long * 3) for name in ("shape", "half", "search")),
        *((name, _pointer) for name in ("volume", "corner", "offset", "ramp", "rho")),
    ]


class ImageArguments(ctypes.Structure):
    """sph_images of csrc/interface.h."""

    _fields_ = [
        ("threads", _int),
        ("images", _long),
        *((name, _long * 3) for name in ("shape", "margin")),
        *((name, _pointer) for name in ("samples", "volume", "power", "turn")),
    ]


class BoxArguments(ctypes.Structure):
    """sph_boxes of csrc/interface.h."""

    _fields_ = [
        ("threads", _int),
        *((name, _long) for name in ("points", "parts")),
        *((name, _long * 3) for name in ("shape", "reach")),
        *((name, _pointer) for name in ("field", "middle", "out")),
    ]


class GriddingArguments(ctypes.Structure):
    """sph_gridding of csrc/interface.h."""

    _fields_ = [
        *((name, _int) for name in ("threads", "dimension", "width")),
        ("shape_parameter", _real),
        *((name, _real * 3) for name in ("origin", "spacing")),
        ("counts", _long * 3),
        ("points", _long),
        *((name, _pointer) for name in ("position", "values", "field")),
    ]


# the structures of csrc/interface.h
MIRRORS: dict[str, type[ctypes.Structure]] = {
    "sph_search": SearchArguments,
    "sph_sizes": Sizes,
    "sph_lists": ListArguments,
    "sph_pass": PassArguments,
    "sph_poisson": PoissonArguments,
    "sph_interpolation": InterpolationArguments,
    "sph_closest": ClosestArguments,
    "sph_look_up": LookUpArguments,
    "sph_walls": WallArguments,
    "sph_correlation": CorrelationArguments,
    "sph_images": ImageArguments,
    "sph_boxes": BoxArguments,
    "sph_gridding": GriddingArguments,
}


def layouts(mirrors: dict[str, type[ctypes.Structure]] = MIRRORS) -> list[tuple[str, str, int, int]]:
    """Structure, field (or "" for the structure itself), offset and size of everything above, in bytes."""
    rows = []
    for name, mirror in mirrors.items():
        rows.append((name, "", 0, ctypes.sizeof(mirror)))
        for field, *_ in mirror._fields_:
            place = getattr(mirror, field)
            rows.append((name, field, place.offset, place.size))
    return rows
