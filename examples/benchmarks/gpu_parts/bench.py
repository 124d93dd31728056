"""What the parts share: the device, a clock that waits for it, and where rows go."""

from __future__ import annotations

import json
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import torch


class Bench:
    """A device with its clock.

    Args:
        device: "cuda" or "cpu".
        fast: whether every part is to be tiny.
        recording: of a ventricle; it may be missing.
        rows: where rows are written, one line of JSON each.
    """

    def __init__(self, device: str, fast: bool, recording: Path, rows: TextIO) -> None:
        self.device, self.fast, self.recording, self._rows = device, fast, recording, rows
        self.cuda = torch.device(device).type == "cuda"
        self.failed = False

    def add(self, **row: object) -> None:
        """Keep a row, whatever becomes of the process."""
        self._rows.write(json.dumps(row) + "\n")
        self._rows.flush()

    @contextmanager
    def attempt(self, **what: object) -> Iterator[None]:
        """Go on after a failure inside, which becomes a row of its own."""
        try:
            yield
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            text = str(error).splitlines() or [""]
            self.add(**what, error=f"{type(error).__name__}: {text[0][:300]}")
            if self.cuda and "CUDA error" in str(error):
                raise  # the context is broken: nothing after this would mean anything

    def wait(self) -> None:
        """Until the device has done all that it was asked."""
        if self.cuda:
            torch.cuda.synchronize()

    def seconds(self, work: Callable[[], object], *, repeats: int = 5, least: float = 0.2) -> float:
        """The shortest of some runs, after one that compiles; each run repeats ``work`` for ``least`` seconds or so."""
        work()
        self.wait()
        once = self._timed(work, 1)
        calls = max(1, round(least / max(once, 1e-6))) if not self.fast else 1
        return min(self._timed(work, calls) for _ in range(1 if self.fast else repeats)) / calls

    def _timed(self, work: Callable[[], object], calls: int) -> float:
        self.wait()
        began = time.perf_counter()
        for _ in range(calls):
            work()
        self.wait()
        return time.perf_counter() - began

    @property
    def memory(self) -> float:
        """GB that tensors took at most on the GPU since it was last asked; 0 on a CPU."""
        if not self.cuda:
            return 0.0
        most = torch.cuda.max_memory_allocated() / 1e9
        torch.cuda.reset_peak_memory_stats()
        return most
