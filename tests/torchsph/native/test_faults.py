"""What goes wrong in compiled code is an exception of Python's: none ends the process, and the next call works."""

from __future__ import annotations

import ctypes
import re
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import torch

import regularize.native.library as splines
import torchsph.native.build as pairs_build
from regularize.native import build as splines_build
from regularize.native.faults import CompiledFault, raise_faults
from torchsph import pairs
from torchsph.native.library import LibraryMissing, library

ENTRY = re.compile(
    r'^(?:  )?(?:extern "C" )?(?:const )?\w+\*? (?P<name>(?:sph|spline)_[\w#]+|SPH_NAME\(\w+\))\([^{;]*\)\s*\{'
    r"(?P<body>.*?)(?:^\}|^  \}$| \}$)",
    re.MULTILINE | re.DOTALL,
)
# they tell what is known already, and neither allocate nor throw
PLAIN = {"sph_runs", "sph_fault", "sph_layouts", "sph_fma", "spline_runs", "spline_fault"}
PLAIN |= {"spline_tile_width", "spline_set_threads"}


def compiled() -> bool:
    try:
        return library() is not None and splines.available()
    except LibraryMissing:
        return False


needs_compiled = pytest.mark.skipif(not compiled(), reason="no compiled library")


@contextmanager
def little_memory(more: int) -> Iterator[None]:
    """Let this process have no more than so many further bytes."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + more, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def test_every_entry_is_guarded() -> None:
    for folder, least in ((pairs_build.SOURCE, 18), (splines_build.SOURCE, 7)):
        entries = {}
        for source in sorted(folder.glob("*.cpp")):
            for found in ENTRY.finditer(source.read_text(encoding="utf-8")):
                entries[found["name"]] = found["body"]
        guarded = {name for name, body in entries.items() if "guard::call(" in body}
        assert entries.keys() - guarded <= PLAIN and len(guarded) >= least, sorted(entries)


@needs_compiled
@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="the memory in use is read from /proc")
def test_a_lack_of_memory_in_compiled_code_is_a_memory_error() -> None:
    """A search of 900,000 members wants a table of each; a strip of a band of 3 million columns wants 3 GB."""
    backend = pairs.choose_backend("cpu")
    draw = torch.Generator().manual_seed(0)
    position, member = torch.rand(200, 3, generator=draw) * 5, torch.zeros(200, dtype=torch.int64)
    many = member.clone()
    many[-1] = 900_000
    before = backend.search(position, member, 1.0).lists
    with little_memory(32 << 20), pytest.raises(MemoryError, match="out of memory in sph_sort_f32; use a larger"):
        backend.search(position, many, 1.0)
    after = backend.search(position, member, 1.0).lists
    for part in (0, 1, 3):  # slots, owners, offsets
        assert torch.equal(before[part], after[part])
    band, reach = torch.ones(2, 3_000_000, dtype=torch.float64), torch.tensor([1, 1])
    with little_memory(1 << 30), pytest.raises(MemoryError, match="out of memory in spline_factor_f64; use wider"):
        splines.factorise(band, reach)
    band = torch.tensor([[4.0, 2.0], [5.0, 0.0]], dtype=torch.float64)
    assert splines.factorise(band, reach)
    torch.testing.assert_close(band[:, 0], torch.tensor([2.0, 2.0], dtype=torch.float64))


def test_other_faults_keep_their_words() -> None:
    """A library whose function has failed, as ctypes shows it."""

    def fault(text: ctypes.Array[ctypes.c_char] | None, room: int) -> int:
        if text is not None:
            text.value = b"more cells than an int32 can number"[: room - 1]
        return 2

    handle = SimpleNamespace(fault=fault, run=SimpleNamespace())
    raise_faults(cast(ctypes.CDLL, handle), "fault", {"run": "nothing"})
    with pytest.raises(CompiledFault, match="run: more cells than an int32"):
        handle.run.errcheck(0, None, None)
    handle.fault = lambda text, room: 0
    raise_faults(cast(ctypes.CDLL, handle), "fault", {"run": "nothing"})
    assert handle.run.errcheck(7, None, None) == 7
    with pytest.raises(AttributeError):
        raise_faults(cast(ctypes.CDLL, SimpleNamespace(run=None)), "fault", {})
