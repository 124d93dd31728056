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
from dataclasses import dataclass

import torch
from torch import Tensor

from ..cell_search import _cells, _key, _shifted
from ..interface import Moments, PairState, Support, check_search
from . import plan
from .planned import PlannedBackend, lengths
from .reference import SINGULARITY, ReferenceBackend


@dataclass(frozen=True)
class CellRuns:
    """Particles in cell order and, for each, the runs [start, stop) of particles in the cells around it.

    Attributes:
        order: (N,) int64, cell order -> particle. member: (N,) int32 in cell order.
        start, stop: (R, N) int32 in cell order; R = 3^(D-1) rows of three cells, or 3^D cells where the first
            axis is periodic.
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


class CudaBackend(PlannedBackend):
    """Pair sums in Triton, float32 or float64; not differentiable."""

    name = "cuda"

    def __init__(self) -> None:
        from .triton_kernels import pair_sums  # triton comes with torch's CUDA builds only

        self._kernel = pair_sums
        interpreted = os.environ.get("TRITON_INTERPRET") == "1"
        self.device = "cpu" if interpreted else "cuda"
        # the interpreter's time goes with the number of programs, whatever their width
        self._block = 1024 if interpreted else 64

    def search(
        self,
        position: Tensor,
        member: Tensor,
        radius: float,
        *,
        margin: float = 0.0,
        period: Tensor | None = None,
    ) -> CellRuns:
        self.check(position)
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
        kind, (reach, sigma) = plan.kernel_choice(support, self.name)
        outputs = plan.allocate(request.terms, state.position)
        if pairs.count == 0:
            return outputs
        packed, rows = _pack(pairs, state, request, field, active)
        table = plan.coefficients(support, request.momentum, pairs.members)
        own_stress = _own_stress(packed, rows, request)
        width = sum(output[0].numel() for output in outputs)
        raw = packed.new_empty((width, pairs.count))
        terms = {name: bool(request.terms & getattr(plan, name)) for name in _TERMS}
        jumps = plan.CONTINUITY | plan.XSPH | plan.ARTIFICIAL | plan.LAMINAR
        periods = packed.new_tensor([*pairs.period, float("inf")][:3])
        self._kernel[(triton_blocks(pairs.count, self._block),)](
            packed,
            own_stress,
            raw,
            _kernel_coefficients(table).to(packed),
            pairs.member,
            pairs.start,
            pairs.stop,
            periods,
            reach,
            pairs.count,
            D=state.position.shape[1],
            KERNEL=kind,
            RANGES=pairs.start.shape[0],
            PERIODIC=any(length != float("inf") for length in pairs.period),
            BLOCK=self._block,
            JUMPS=bool(request.terms & jumps),
            APPROACH=bool(request.terms & (plan.CONTINUITY | plan.ARTIFICIAL)),
            **terms,
            **{name: rows.get(name, 0) for name in _ROWS},
        )
        return _scaled(raw, outputs, pairs, request, table[:, 0], sigma, packed, rows)


def triton_blocks(count: int, block: int) -> int:
    """How many programs of ``block`` particles cover ``count``."""
    return (count + block - 1) // block


_OLDEST_TRITON = (3, 3)  # the first whose kernels may hold tuples
_TERMS = (
    "CONTINUITY",
    "DIFFUSION",
    "CONCENTRATION",
    "XSPH",
    "PRESSURE",
    "ARTIFICIAL",
    "LAMINAR",
    "TENSILE",
    "SHEPARD",
    "RENORMALISATION",
    "LAPLACIAN",
    "GRADIENT",
    "CORRECTED_DIFFUSION",
    "MOMENTS",
)
_ROWS = ("WEIGHT", "STRESS", "INERTIA", "INVERSE", "DEVIATION", "MASS", "FIELD", "SLOPE")


def _pack(
    pairs: CellRuns, state: PairState, request: plan.Pass, field: Tensor | None, active: Tensor | None
) -> tuple[Tensor, dict[str, int]]:
    """(F, N) fields in cell order, and the row of each: position, velocity, ..., the factor of a."""
    density = 1.0 + state.deviation
    by_volume = request.weight == plan.BY_VOLUME
    weight = state.mass / density if by_volume else state.mass
    if active is not None:
        weight = weight * active
    symmetric = request.momentum is not None and request.momentum.pressure == "symmetric"
    quantities: dict[str, Tensor] = {"WEIGHT": weight}
    if request.terms & plan.PRESSURE:
        quantities["STRESS"] = state.pressure / density**2 if symmetric else state.pressure
    quantities["INERTIA"] = 1.0 / density if by_volume else density
    quantities["INVERSE"] = density if by_volume else 1.0 / density
    quantities["DEVIATION"] = state.deviation
    if request.terms & (plan.SHEPARD | plan.MOMENTS):
        quantities["MASS"] = state.mass
    if field is not None:
        quantities["FIELD"] = field
    if request.terms & plan.CORRECTED_DIFFUSION:
        quantities |= {name: part for name, part in zip(("SLOPE", "SLOPE_Y", "SLOPE_Z"), state.slope.T, strict=False)}
    quantities["FACTOR"] = 1.0 / density if by_volume else torch.ones_like(density)
    if field is not None:
        quantities["FACTOR"] = torch.ones_like(density) if active is None else active.to(density.dtype)
    vectors = [*state.position.T, *state.velocity.T]
    packed = torch.stack([*vectors, *quantities.values()])[:, pairs.order].contiguous()
    return packed, {name: len(vectors) + row for row, name in enumerate(quantities)}


def _own_stress(packed: Tensor, rows: dict[str, int], request: plan.Pass) -> Tensor:
    """The pressure with which a particle a enters its own sum: |p| or -p in two of the forms."""
    if not request.terms & plan.PRESSURE:
        return packed
    stress = packed[rows["STRESS"]]
    form = request.momentum.pressure
    return stress.abs() if form == "switched" else -stress if form == "difference" else stress


def _kernel_coefficients(table: Tensor) -> Tensor:
    length, artificial, laminar, tensile = table.T
    columns = (1.0 / length, SINGULARITY * length**2, 2.0 * artificial * length, laminar, tensile)
    return torch.stack(columns, 1).contiguous()


def _scaled(
    raw: Tensor,
    outputs: list[Tensor],
    pairs: CellRuns,
    request: plan.Pass,
    length: Tensor,
    sigma: float,
    packed: Tensor,
    rows: dict[str, int],
) -> list[Tensor]:
    """Sums with their prefactors, in the caller's order of particles."""
    dimension = len(pairs.period)
    member = pairs.member.to(torch.int64)
    value, slope = ((sigma / length ** (dimension + power)).to(raw)[member] for power in (0, 2))
    factor = packed[rows["FACTOR"]]
    scales = {
        "diffusion": 2.0 * slope,
        "xsph": 2.0 * value * factor,
        "acceleration": slope * factor,
        "shepard_volume": value,
        "shepard_mass": value,
        "moment_first": value,
        "moment_second": value,
        "moment_mass": value,
        "laplacian": 2.0 * slope * factor,
        "diagonal": 2.0 * slope * factor,
    }
    row = 0
    for name, output in zip(request.outputs, outputs, strict=True):
        width = output[0].numel()
        part = raw[row : row + width] * scales.get(name, slope)
        output[pairs.order] = part.T.reshape(output.shape)
        row += width
    return outputs


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
