"""Memory that a run will take, before it takes it; what is free, and what to change where that is less.

The parts and their sizes are counted from the recording and the options; what a particle, a spline's sample or a node
of a wall's table costs was measured on the CPU: within a quarter of what runs took
(`examples/benchmarks/runs/memory.py`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

import geometry
from regularize.rows.operators import System, VectorRows
from regularize.smoothing.knot_grid import knots_for
from regularize.smoothing.samples import FitData
from regularize.solvers.memory import band_bytes
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.simulator.schemes.scheme import Scheme
from torchsph.simulator.walls.fields import TABLES_KEPT, TABLES_MEMORY

from .measurement.frame_splines import FrameSmoother
from .runtime.control_groups import OWN, ROOT, control_groups

_BANDS = 4  # copies of a spline's band that live at once while its smoothness is chosen
_PER_SAMPLE = 10_000  # bytes of rows and of errors that neighbours share
# beyond this these rows are in blocks so large (32 MB, glibc's M_MMAP_THRESHOLD) that freeing gives them back
_ROWS_KEPT = 64 << 20
_PER_PARTICLE = {2: 1_000, 3: 3_000}  # bytes of state, neighbours and sums
_SETS_OF_OPENINGS = 2  # tables for each key time where there are valves, which open and close in between
_TABLES_IN_MAKING = 3  # what transforms and distances take while one is made
_PROGRAM = 250 << 20  # a worker with all that it has imported, before its work
_LIBRARIES = 36 << 20  # what is loaded at the first fit and the first step
_COPIES_OF_RECORDING, _COPIES_OF_MEMBERS = 10, 6
# the analysis gathers each number of the state for the patches that share it, in parts of 32 MB, three at a time
_GATHERED, _PARTS = 32 << 20, 3


class NotEnoughMemory(MemoryError):
    """A run would need more memory than is free; the message says what to change."""


@dataclass(frozen=True)
class MemoryPrediction:
    """Bytes that a run takes beyond what its process has at the start, by what they are for.

    Attributes:
        splines: bands and rows while the smoothness is chosen.
        particles: of all runs that live at once.
        tables: of the walls.
        members: grid fields of the ensemble.
        recordings: the measurement's arrays and those of the results.
        released: part of the splines' that is free again for particles and tables.
        processes: that share the run.
    """

    splines: int
    particles: int
    tables: int
    members: int
    recordings: int
    released: int = 0
    processes: int = 1

    @property
    def total(self) -> int:
        """Bytes."""
        simulated = max(0, self.particles + self.tables - self.released)
        each = _LIBRARIES + self.splines + simulated + self.members + self.recordings
        return self.processes * each + (self.processes - 1) * _PROGRAM

    def in_processes(self, count: int) -> MemoryPrediction:
        """At most what it takes in so many processes: any of them may come to hold all that one alone does."""
        return replace(self, processes=count)

    def fits(self, free: int | None) -> bool:
        """Whether so many bytes are enough; where nobody knows how many are free, they are."""
        return free is None or self.total <= free

    def refuse_beyond(self, free: int | None) -> None:
        """Refuse a run that does not fit.

        Args:
            free: bytes; None where nobody knows.

        Raises:
            NotEnoughMemory: it needs more.
        """
        if self.fits(free) or free is None:
            return
        parts = {name: size for name, size in vars(self).items() if size > 0 and name in _CURES}
        largest = max(parts, key=lambda name: parts[name])
        told = ", ".join(f"{name} {_size(size)}" for name, size in sorted(parts.items(), key=lambda one: -one[1]))
        shared = f" in each of {self.processes} processes" if self.processes > 1 else ""
        cure = "try fewer --workers" if self.processes > 1 else _CURES[largest]
        raise NotEnoughMemory(
            f"needs about {_size(self.total)} of memory ({told}{shared}), but only {_size(free)} are free; {cure}"
        )


_CURES = {
    "splines": "give a recording on a coarser grid, or of a smaller part",
    "particles": "try a larger --spacing",
    "tables": "try a larger --spacing",
    "members": "try fewer --members",
    "recordings": "give fewer frames, or a coarser grid",
}


def predicted(
    recording: geometry.Recording,
    scheme: Scheme,
    *,
    splines: FrameSmoother | None = None,
    spacings: Iterable[tuple[float, int]] = (),
    members: int = 0,
    copies: int = _COPIES_OF_RECORDING,
    further: Iterable[geometry.Recording] = (),
) -> MemoryPrediction:
    """What a run on a recording will take at its peak.

    Args:
        recording: the measurement, or what is forecast.
        scheme: of the simulators.
        splines: its fits; None where none are made.
        spacings: particle spacing (m) and number of members of every simulation that lives beside others.
        members: of the ensemble; 0 without one.
        copies: of all frames that are made on the way.
        further: more measurements of the beat.
    """
    dimension, field = recording.dimension, 4 * recording.dimension * recording.grid.size
    most = int(recording.mask.reshape(recording.frames, -1).sum(1).max())
    volume = most * float(np.prod(recording.grid.spacing))
    runs = list(spacings)
    particles = sum(int(count * volume / spacing**dimension) for spacing, count in runs) * _PER_PARTICLE[dimension]
    arrays = sum(value.nbytes for one in (recording, *further) for value in one.arrays().values())
    gathered = 4 * dimension * 2**dimension * most * members
    bands, rows = (0, 0) if splines is None else _splines(splines)
    return MemoryPrediction(
        splines=bands + rows,
        particles=particles,
        tables=sum(_tables(recording, scheme, spacing) for spacing in dict(runs)),
        members=_COPIES_OF_MEMBERS * members * field + _PARTS * min(_GATHERED, gathered),
        recordings=arrays + copies * recording.frames * field,
        # an ensemble fits again while its members live; else splines are done before particles are made
        released=max(0, rows - _ROWS_KEPT) if members else bands + rows,
    )


def _splines(splines: FrameSmoother) -> tuple[int, int]:
    """Bytes of bands and of rows: of the frame with the most nodes in its mask, by the knots that its fit will have."""
    recording = splines.recording
    frame = int(np.argmax(recording.mask.reshape(recording.frames, -1).sum(1)))
    inside = torch.from_numpy(np.array(recording.mask[frame], bool).reshape(-1))
    points = splines.nodes[inside].double()
    if not len(points):
        return 0, 0
    silent = torch.zeros_like(points)
    data = FitData.checked(points, silent, divergence_points=points)
    knots = knots_for(data, splines.smoother)
    band = band_bytes(System(knots, recording.dimension, [VectorRows(knots, points, silent, silent)], 0.0))
    return _BANDS * band, _PER_SAMPLE * len(points)


def _tables(recording: geometry.Recording, scheme: Scheme, spacing: float) -> int:
    """Of the walls at a particle spacing: those that are kept, and one in the making."""
    vertices = recording.wall_for("the simulator").vertices.reshape(-1, recording.dimension)
    margin = (kernel(scheme.kernel).support * scheme.smoothing_ratio + 2.0) * spacing
    nodes = float(np.prod(np.floor((np.ptp(vertices, axis=0) + 2 * margin) / (0.5 * spacing)) + 2))
    channels = 1 + 2 * recording.dimension
    if scheme.wall.complete:
        channels += 1 + recording.dimension + int(scheme.wall.sliding)
    each = 4 * channels * nodes
    moving = recording.frames if recording.wall_for("the simulator").moves else 1
    sets = 1 if recording.valve_intervals is None and recording.valve_open is None else _SETS_OF_OPENINGS
    kept = min(sets * moving, max(TABLES_KEPT, TABLES_MEMORY // each))
    return int(each * (kept + _TABLES_IN_MAKING))


def free_memory() -> int | None:
    """Bytes that this process may still take: what the machine has left, and the control group; None if unknown."""
    found = [size for size in (_machine(), _control_group()) if size is not None]
    return min(found, default=None)


def _machine() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):
        return None


def _control_group(root: Path = ROOT, own: Path = OWN) -> int | None:
    """What the tightest of the groups around this process leaves (cgroup v2, or v1's memory controller)."""
    first = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file ")
    sizes = [
        _left(folder, *(("memory.max", "memory.current", "inactive_file ") if second else first))
        for folder, second in control_groups("memory", root, own)
    ]
    return min((size for size in sizes if size is not None), default=None)


def _left(folder: Path, most: str, used: str, cache: str) -> int | None:
    try:
        limit = (folder / most).read_text(encoding="ascii").strip()
        if limit == "max":
            return None
        taken = int((folder / used).read_text(encoding="ascii"))
        lines = (folder / "memory.stat").read_text(encoding="ascii").splitlines()
    except (OSError, ValueError):  # no such group here, or another kind of file
        return None
    spare = next((int(line.split()[1]) for line in lines if line.startswith(cache)), 0)
    return max(0, int(limit) - taken + spare)


def _size(count: float) -> str:
    return f"{count / 1e9:.3g} GB" if count >= 1e9 else f"{count / 1e6:.3g} MB"
