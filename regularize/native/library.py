"""The compiled assembly (csrc/spline.cpp) and band algebra (csrc/band.cpp) behind the calls of the torch reference.

The install builds three shared libraries (see ``build``); the best one that the processor can run is loaded at
first use. ``available()`` says whether there is one.
"""

from __future__ import annotations

import ctypes
from copy import copy
from functools import lru_cache

import torch

from regularize.basis.bspline import pieces
from regularize.errors import InvalidInput
from regularize.rows.assembly import cell_gram, empty_band
from regularize.rows.operators import (
    CellRows,
    DirectionRows,
    DivergenceRows,
    PointRows,
    RowBlock,
    System,
    VectorRows,
    at_points,
)
from regularize.rows.ordering import Ordering

from . import build, loader
from .checks import check_array, check_band, check_sizes, check_slots
from .faults import raise_faults

FAMILY = loader.Family(build.LIBRARIES, build.STEM, "spline_runs", "regularize.native.build")
GUARDED = ("gram", "gradient", "sort", "factor_f64", "factor_f32", "solve_f64", "solve_f32")
CURE = "use wider knots, or fewer frames at once"
KINDS = {VectorRows: 0, DirectionRows: 1, DivergenceRows: 2}


class _Grid(ctypes.Structure):
    _fields_ = [
        ("axes", ctypes.c_int32),
        ("components", ctypes.c_int32),
        ("degree", ctypes.c_int32),
        ("padded", ctypes.c_int32),
        ("axis_of_component", ctypes.c_int32 * 4),
        ("spacing", ctypes.c_double * 4),
        ("pieces", ctypes.c_double * 36),
        ("cells", ctypes.c_int64),
        ("nodes", ctypes.c_int64),
        ("position", ctypes.c_void_p),
    ]


class _Rows(ctypes.Structure):
    _fields_ = [
        ("kind", ctypes.c_int32),
        ("shared", ctypes.c_int32),
        ("count", ctypes.c_int64),
        ("start", ctypes.c_void_p),
        ("t", ctypes.c_void_p),
        ("coefficient", ctypes.c_void_p),
        ("gram", ctypes.c_void_p),
    ]


@lru_cache
def library() -> ctypes.CDLL | None:
    """The library for the best instruction set of this processor; None where nothing was compiled.

    Raises:
        LibraryMissing: ``TORCHSPH_ISA`` names an instruction set that is unknown or not here, or what was compiled
            cannot be loaded.
    """
    if not FAMILY.path("baseline").is_file():
        return None
    found = loader.choose(FAMILY)
    handle = found.handle
    for name in ("gram", "gradient", "sort", "set_threads", "solve_f64", "solve_f32"):
        getattr(handle, f"spline_{name}").restype = None
    try:
        raise_faults(handle, "spline_fault", {f"spline_{name}": CURE for name in GUARDED})
    except AttributeError as fault:
        raise loader.LibraryMissing(loader.outdated(FAMILY, found.instruction_set)) from fault
    return handle


def available() -> bool:
    """Whether a compiled library was built with this install."""
    return library() is not None


def _loaded() -> ctypes.CDLL:
    """The library, where somebody has asked for compiled code."""
    lib = library()
    if lib is None:
        raise InvalidInput("no compiled library was built with this install: use the engine 'reference'")
    return lib


def _address(tensor: torch.Tensor | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())


def _size(band: torch.Tensor) -> tuple[ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64]:
    return _address(band), ctypes.c_int64(len(band)), ctypes.c_int64(band.shape[1])


def factorise(band: torch.Tensor, reach: torch.Tensor) -> bool:
    """As :func:`regularize.solvers.cholesky.factorise`."""
    lib = _loaded()
    check_band(band, reach)
    lib.spline_set_threads(torch.get_num_threads())
    run = lib.spline_factor_f64 if band.dtype == torch.float64 else lib.spline_factor_f32
    return bool(run(*_size(band), _address(reach)))


def solve(band: torch.Tensor, reach: torch.Tensor, right: torch.Tensor, *, lower: bool, upper: bool) -> torch.Tensor:
    """x (n, k) with L x = right, L' x = right or, with both, L L' x = right for the factor L in the band."""
    lib = _loaded()
    check_band(band, reach)
    if right.ndim != 2 or right.device != band.device or right.dtype != band.dtype or len(right) != len(band):
        raise InvalidInput(
            f"the right-hand side is {tuple(right.shape)} of {right.dtype} on '{right.device}': it must be "
            f"({len(band)}, k) of {band.dtype} on '{band.device}', as the factor"
        )
    x = right.T.contiguous().clone()
    lib.spline_set_threads(torch.get_num_threads())
    run = lib.spline_solve_f64 if band.dtype == torch.float64 else lib.spline_solve_f32
    parts = ctypes.c_int32(lower + 2 * upper)
    run(*_size(band), _address(reach), parts, ctypes.c_int64(len(x)), _address(x))
    return x.T.contiguous()


class PackedSystem:
    """A system in solve order: rows sorted by cell with their 1-D values, ready for the compiled code.

    Vectors here are (active coefficients, C) in solve order; everything is float64 on the CPU.
    """

    def __init__(self, system: System, ordering: Ordering) -> None:
        self.system, self.ordering, self.lib = system, ordering, _loaded()
        check_sizes(system, ordering)
        self._keep: list[object] = []
        self.slabs = ordering.slabs().contiguous()
        knots, tile = ordering.knots, self.lib.spline_tile_width()
        place = [ordering.axes.index(k) for k in range(system.components)]
        self.grid = _Grid(
            axes=knots.axes,
            components=system.components,
            degree=knots.degree,
            padded=-(-knots.local_size // tile) * tile,
            axis_of_component=(ctypes.c_int32 * 4)(*place),
            spacing=(ctypes.c_double * 4)(*[knots.spacing[k] for k in ordering.axes]),
            pieces=(ctypes.c_double * 36)(*pieces(knots.degree).T.flatten()),
            cells=len(ordering.keys),
            nodes=len(ordering.nodes),
            position=self._pointer(ordering.position.int()),
        )
        self.lib.spline_set_threads(torch.get_num_threads())
        self.sorted: list[torch.Tensor] = []
        self.rows = [self._pack(block) for block in system.blocks]

    def with_weights(self, system: System) -> PackedSystem:
        """The blocks of ``system``, of which those at the same points need no new sorting."""
        other = copy(self)
        other.system, other._keep = system, [self]  # which holds the memory that stays in use
        pairs = list(zip(system.blocks, self.system.blocks, strict=True))
        if any(new is not old and (isinstance(new, CellRows) or new.cell is not old.cell) for new, old in pairs):
            raise InvalidInput("the systems differ in more than the weights and values of rows at the same points")
        other.rows = [
            rows if new is old else other._reweighed(at_points(new), rows, index)
            for (new, old), rows, index in zip(pairs, self.rows, self.sorted, strict=True)
        ]
        return other

    def band(self) -> torch.Tensor:
        """As :func:`regularize.rows.assembly.reference_band`."""
        band = empty_band(self.system, self.ordering)
        blocks = (_Rows * len(self.rows))(*self.rows)
        self.lib.spline_gram(
            ctypes.byref(self.grid),
            blocks,
            ctypes.c_int32(len(self.rows)),
            _address(self.slabs),
            ctypes.c_int64(len(self.slabs) - 1),
            _address(band),
            ctypes.c_int64(band.shape[1]),
        )
        return band

    def gradient(self, x: torch.Tensor | None) -> torch.Tensor:
        """A'(b - A x) - damping^2 x; A'b where x is None. x and the result (active, C) in solve order."""
        out = torch.zeros(self.grid.nodes, self.grid.components, dtype=torch.float64)
        if x is not None:
            x = x.contiguous()
            check_array("x", x, torch.float64, (self.grid.nodes, self.grid.components))
        self.lib.spline_set_threads(torch.get_num_threads())
        for block, rows, index in zip(self.system.blocks, self.rows, self.sorted, strict=True):
            if isinstance(block, CellRows):
                if x is not None:
                    self._subtract_cells(block, index, x, out)
                continue
            # divergence rows have no target and add nothing to the right-hand side
            target = None if isinstance(block, DivergenceRows) else block.target.double().contiguous()
            if target is not None:
                width = self.grid.components if isinstance(block, VectorRows) else 1
                check_array("the target of a block", target, torch.float64, (len(index) * width,))
            if x is not None or target is not None:
                given = (_address(each) for each in (target, index, x, out))
                slabs = _address(self.slabs), ctypes.c_int64(len(self.slabs) - 1)
                self.lib.spline_gradient(ctypes.byref(self.grid), ctypes.byref(rows), *slabs, *given)
        return out if x is None else out - self.system.damping**2 * x

    def _subtract_cells(self, block: CellRows, slots: torch.Tensor, x: torch.Tensor, out: torch.Tensor) -> None:
        near = self.ordering.position[slots]
        gram = cell_gram(block)[self.ordering.local()][:, :, self.ordering.local()]
        pulled = x[near].flatten(1) @ gram.flatten(0, 1).flatten(1, 2)
        out.index_add_(0, near.flatten(), pulled.view(-1, block.components), alpha=-1.0)

    def _pack(self, block: RowBlock) -> _Rows:
        slot, cells = check_slots(self.ordering, block.cell), len(self.ordering.keys)
        index, start = torch.empty_like(slot), torch.empty(cells + 1, dtype=torch.int64)
        sizes = ctypes.c_int64(len(slot)), ctypes.c_int64(cells)
        self.lib.spline_sort(_address(slot), *sizes, _address(index), _address(start))
        self.sorted.append(slot if isinstance(block, CellRows) else index)
        if isinstance(block, CellRows):
            return self._pack_cells(block, start)
        rows = at_points(block)
        t = rows.t[:, list(self.ordering.axes)][index].double()
        same = _Rows(kind=KINDS[type(rows)], count=len(rows), start=self._pointer(start), t=self._pointer(t))
        return self._reweighed(rows, same, index)

    def _reweighed(self, block: PointRows, same: _Rows, index: torch.Tensor) -> _Rows:
        """``same`` rows, sorted by ``index``, with the weights and directions of ``block``."""
        weight = block.weight[index].double()
        shared = False
        if isinstance(block, VectorRows):
            coefficient, shared = weight, bool((weight == weight[:, :1]).all())
        elif isinstance(block, DirectionRows):
            coefficient = weight[:, None] * block.direction[index].double()
        else:
            coefficient = weight[:, None].repeat(1, block.components)
        held = self._pointer(coefficient)
        return _Rows(same.kind, shared, same.count, same.start, same.t, held)

    def _pack_cells(self, block: CellRows, start: torch.Tensor) -> _Rows:
        local = self.ordering.local()
        gram = cell_gram(block)[local][:, :, local].permute(1, 3, 0, 2)  # (C, C, L, L)
        scalar = not block.coupled
        gram = gram[0, 0] if scalar else gram
        return _Rows(kind=3 if scalar else 4, count=0, start=self._pointer(start), gram=self._pointer(gram))

    def _pointer(self, tensor: torch.Tensor) -> int:
        """Address of a contiguous copy that lives as long as this object."""
        tensor = tensor.contiguous()
        self._keep.append(tensor)
        return tensor.data_ptr()
