"""The Triton backend: cell order, runs of neighbouring cells, one kernel for all terms; no compiler.

Search and packing are torch operations on the device; only the pair loop is a Triton kernel.  With
``TRITON_INTERPRET=1`` set before triton is imported the same code runs on CPU tensors, slowly, for tests.

Estimate for 3-D, h = 1.2 spacings, continuity, pressure, artificial viscosity and XSPH in float32: a lane
meets 373 candidates (27 cells of 2.4 spacings) for 58 neighbours and spends 57 flop on each, 21 kflop a
particle; it reads 48 bytes of its own fields and 76 of runs and writes 28, and 40 bytes per candidate, 15 kB
a particle, come from caches.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Hashable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..cell_search import _cells, _key, _shifted
from ..interface import Moments, MomentumTerms, PairState, Support, check_search
from ..terms import BY_VOLUME, FIELDS, SLOPE, VALUE, outputs_of, reading
from . import plan
from .checks import check_particles, check_period
from .planned import PlannedBackend, lengths
from .reference import SINGULARITY, ReferenceBackend


@dataclass(frozen=True)
class CellRuns:
    """Particles in cell order and, for each, the runs [start, stop) of particles in the cells around it.

    Attributes:
        order: (N,) int64, cell order -> particle.
        member: (N,) int32, in cell order.
        start: (R, N) int32, in cell order; R = 3^(D-1) rows of three cells, or 3^D cells where the first axis is
            periodic.
        stop: (R, N) int32, likewise.
        period: (D,) floats, inf where an axis is not periodic.
        members: how many members there are.
    """

    order: Tensor
    member: Tensor
    start: Tensor
    stop: Tensor
    period: list[float]
    members: int

    @property
    def count(self) -> int:
        """Number of particles of the search."""
        return self.order.shape[0]


def cell_runs(position: Tensor, member: Tensor, radius: float, period: Tensor | None) -> CellRuns:
    """Sort particles by cells of edge ``radius`` and find the runs of cells around each of them."""
    dimension = position.shape[1]
    lengths_of_axes = lengths(period, dimension)
    if position.shape[0] == 0:
        none = torch.zeros((1, 0), dtype=torch.int32, device=position.device)
        return CellRuns(member, member.to(torch.int32), none, none, lengths_of_axes, 1)
    cell, cells = _cells(position, radius, period)
    key = _key(cell, member, cells)
    key, order = torch.sort(key, stable=True)
    cell, own = cell[order], member[order]
    along = lengths_of_axes[0] == float("inf")  # a row of three cells is one run unless it wraps
    starts, stops = [], []
    for offset in itertools.product((0,) if along else (-1, 0, 1), *[(-1, 0, 1)] * (dimension - 1)):
        target, real = _shifted(cell, offset, cells, period)
        low, high = target, target
        if along:
            low, high = target.clone(), target.clone()
            low[:, 0] = (low[:, 0] - 1).clamp_min(0)
            high[:, 0] = torch.minimum(high[:, 0] + 1, cells[0] - 1)
        first = torch.searchsorted(key, _key(low, own, cells))
        last = torch.searchsorted(key, _key(high, own, cells), right=True)
        starts.append(first)
        stops.append(torch.where(real, last, first))
    start, stop = (torch.stack(runs).to(torch.int32).contiguous() for runs in (starts, stops))
    return CellRuns(order, own.to(torch.int32), start, stop, lengths_of_axes, int(own[-1]) + 1)


@dataclass(frozen=True)
class KernelConstants:
    """What a pass needs beside the particles, on their device.

    Attributes:
        coefficients: (members, 5), as the kernel reads them.
        periods: (3,), inf where an axis is not periodic.
        scale: (members,) prefactors of the sums, by their power of the smoothing length.
    """

    coefficients: Tensor
    periods: Tensor
    scale: dict[int, Tensor]

    @classmethod
    def of(cls, support: Support, momentum: MomentumTerms | None, pairs: CellRuns, like: Tensor) -> KernelConstants:
        """Made anew, in the precision and on the device of ``like``."""
        table, dimension = plan.coefficients(support, momentum, pairs.members), len(pairs.period)
        sigma, length = support.kernel.normalisation[dimension], table[:, 0]
        return cls(
            _kernel_coefficients(table).to(like),
            like.new_tensor([*pairs.period, float("inf")][:3]),
            {power: (sigma / length ** (dimension + power)).to(like) for power in (VALUE, SLOPE)},
        )


class CudaBackend(PlannedBackend[CellRuns]):
    """Pair sums in Triton, float32 or float64; not differentiable."""

    name = "cuda"

    def __init__(self) -> None:
        from . import triton_kernels  # triton comes with torch's CUDA builds only

        self._kernels = triton_kernels
        interpreted = os.environ.get("TRITON_INTERPRET") == "1"
        self.device = "cpu" if interpreted else "cuda"
        # the interpreter's time goes with the number of programs, whatever their width
        self._block = 1024 if interpreted else 64
        self._sent: dict[Hashable, KernelConstants] = {}

    def search(
        self,
        position: Tensor,
        member: Tensor,
        radius: float,
        *,
        margin: float = 0.0,
        period: Tensor | None = None,
    ) -> CellRuns:
        """See ``Backend.search``."""
        self.check(position)
        check_particles(position, member)
        check_period(period, position.shape[1])
        check_search(position, radius + margin, period)
        return cell_runs(position, member, radius + margin, period)

    def interpolate(
        self,
        position: Tensor,
        member: Tensor,
        fields: Tensor,
        support: Support,
        query: Tensor,
        query_member: Tensor,
        *,
        period: Tensor | None = None,
        weight: Tensor | None = None,
    ) -> Moments:
        # once per recorded frame: the reference's torch on this device is fast enough
        """See ``Backend.interpolate``."""
        return ReferenceBackend().interpolate(
            position, member, fields, support, query, query_member, period=period, weight=weight
        )

    def _evaluate(
        self,
        pairs: CellRuns,
        state: PairState,
        support: Support,
        request: plan.Pass,
        field: Tensor | None = None,
        active: Tensor | None = None,
    ) -> list[Tensor]:
        kind, (reach, _) = plan.kernel_choice(support, self.name)
        outputs = plan.allocate(request.terms, state.position)
        if pairs.count == 0:
            return outputs
        terms = request.terms
        packed, factor = self._pack(pairs, state, request, field, active)
        constants = self._constants(support, request.momentum, pairs, packed)
        width = sum(output[0].numel() for output in outputs)
        raw = packed.new_empty((width, pairs.count))
        self._kernels.pair_sums[(triton_blocks(pairs.count, self._block),)](
            packed,
            self._own_stress(packed, request, state.position.shape[1]),
            raw,
            constants.coefficients,
            pairs.member,
            pairs.start,
            pairs.stop,
            constants.periods,
            reach,
            pairs.count,
            D=state.position.shape[1],
            KERNEL=kind,
            RANGES=pairs.start.shape[0],
            PERIODIC=any(length != float("inf") for length in pairs.period),
            BLOCK=self._block,
            TERMS=terms,
        )
        _scale(raw, outputs, pairs, terms, constants.scale, factor)
        return outputs

    def _constants(
        self, support: Support, momentum: MomentumTerms | None, pairs: CellRuns, like: Tensor
    ) -> KernelConstants:
        """The numbers of a pass; sent to the device once where they are plain, for a solver asks for them often."""
        terms = None if momentum is None else (momentum.artificial, momentum.laminar, momentum.tensile)
        numbers = (support.length, *(terms or ()))
        if any(isinstance(value, Tensor) for value in numbers):
            return KernelConstants.of(support, momentum, pairs, like)
        kind = (support.kernel.name, support.kernel.support, support.length, support.dimension, momentum)
        key = (*kind, pairs.members, tuple(pairs.period), like.dtype, like.device)
        if key not in self._sent:
            while len(self._sent) >= _CONSTANTS_KEPT:
                self._sent.pop(next(iter(self._sent)))
            self._sent[key] = KernelConstants.of(support, momentum, pairs, like)
        return self._sent[key]

    def _pack(
        self, pairs: CellRuns, state: PairState, request: plan.Pass, field: Tensor | None, active: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """(F, N) fields in cell order, of which those that no term reads hold nothing, and the factor (N,) of a."""
        quantities = {"position": state.position.T, "weight": _weight(state, request, active)[None]}
        for name in FIELDS:
            if request.terms & reading(name):
                quantities[name] = _field(name, state, request, field)
        rows = plan.rows_of(state.position.shape[1])
        packed = state.position.new_empty((max(row.stop for row in rows.values()), pairs.count))
        for name, values in quantities.items():
            packed[rows[name]] = values[:, pairs.order]
        return packed, _factor(state, request, active)[pairs.order]

    def _own_stress(self, packed: Tensor, request: plan.Pass, dimension: int) -> Tensor:
        """The pressure with which a particle a enters its own sum: |p| or -p in two of the forms."""
        if request.momentum is None or request.momentum.pressure is None:
            return packed
        stress = packed[plan.rows_of(dimension)["stress"]]
        form = request.momentum.pressure
        return stress.abs() if form == "switched" else -stress if form == "difference" else stress


def triton_blocks(count: int, block: int) -> int:
    """How many programs of ``block`` particles cover ``count``."""
    return (count + block - 1) // block


_CONSTANTS_KEPT = 64  # of passes: a run has a dozen kinds of them
_OLDEST_TRITON = (3, 3)  # the first whose kernels may hold tuples


def _weight(state: PairState, request: plan.Pass, active: Tensor | None) -> Tensor:
    """w_b of the pass, 0 on inactive particles."""
    weight = state.volume if request.weight == BY_VOLUME else state.mass
    return weight if active is None else weight * active


def _factor(state: PairState, request: plan.Pass, active: Tensor | None) -> Tensor:
    """What a particle's own sums are multiplied by; see csrc/rows.hpp."""
    density = 1.0 + state.deviation
    if request.terms & reading("field"):
        return torch.ones_like(density) if active is None else active.to(density.dtype)
    return 1.0 / density if request.weight == BY_VOLUME else torch.ones_like(density)


def _field(name: str, state: PairState, request: plan.Pass, field: Tensor | None) -> Tensor:
    """One of ``FIELDS``, (1, N) or (D, N)."""
    density, by_volume = 1.0 + state.deviation, request.weight == BY_VOLUME
    if name == "stress":
        symmetric = request.momentum is not None and request.momentum.pressure == "symmetric"
        return (state.pressure / density**2 if symmetric else state.pressure)[None]
    if name == "inertia":
        return (1.0 / density if by_volume else density)[None]
    if name == "inverse":
        return (density if by_volume else 1.0 / density)[None]
    if name == "field" and field is not None:
        return field[None]
    values: Tensor = getattr(state, name)
    return values.T if values.ndim == 2 else values[None]


def _kernel_coefficients(table: Tensor) -> Tensor:
    length, artificial, laminar, tensile = table.T
    columns = (1.0 / length, SINGULARITY * length**2, 2.0 * artificial * length, laminar, tensile)
    return torch.stack(columns, 1).contiguous()


def _scale(
    raw: Tensor, outputs: list[Tensor], pairs: CellRuns, terms: int, scale: dict[int, Tensor], factor: Tensor
) -> None:
    """Write sums with their prefactors into ``outputs``, in the caller's order of particles."""
    member, row = pairs.member.to(torch.int64), 0
    for given, output in zip(outputs_of(terms), outputs, strict=True):
        width = output[0].numel()
        own = given.times * scale[given.power][member]
        part = raw[row : row + width] * (own * factor if given.own else own)
        output[pairs.order] = part.T.reshape(output.shape)
        row += width


def status(device: str) -> tuple[bool, str]:
    """Whether the backend can be used on ``device``, and why (not)."""
    if torch.device(device).type != "cuda":
        return False, f"works on CUDA tensors only, the device asked for is '{device}'"
    if not torch.cuda.is_available():
        return (
            False,
            "torch finds no CUDA device; install a CUDA build of torch on a machine with an NVIDIA GPU",
        )
    try:
        import triton
    except ImportError:
        return False, "triton is not installed; it comes with torch's CUDA builds (pip install triton)"
    if tuple(int(part) for part in triton.__version__.split(".")[:2]) < _OLDEST_TRITON:
        return False, f"Triton {triton.__version__} is too old for the kernels: they need 3.3, from torch 2.7 on"
    return True, f"Triton {triton.__version__} on {torch.cuda.get_device_name()}"
