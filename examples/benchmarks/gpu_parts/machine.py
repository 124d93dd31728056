"""The device itself, and the tests that run on it."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import torch

from .bench import Bench

ROOT = Path(__file__).resolve().parents[3]
# files with tests that take a GPU where there is one
ON_DEVICE = (
    "tests/torchsph/pairs/test_triton.py",
    "tests/torchsph/device/test_pretended.py",
    "tests/regularize/solvers/test_triton.py",
)


def machine(bench: Bench) -> None:
    """Names and versions; bytes and multiply-adds a second, against which the other figures are to be seen."""
    try:
        import triton

        compiler = triton.__version__
    except ImportError:
        compiler = None
    name = torch.cuda.get_device_name() if bench.cuda else platform.processor() or platform.machine()
    total = torch.cuda.get_device_properties(0).total_memory / 1e9 if bench.cuda else 0.0
    bench.add(
        device=name,
        torch=torch.__version__,
        cuda=torch.version.cuda,
        triton=compiler,
        python=platform.python_version(),
        memory_gb=total,
        cores=len(os.sched_getaffinity(0)),
    )
    with bench.attempt(figure="copy"):
        field = torch.rand(1 << (16 if bench.fast else 28), device=bench.device)
        other = torch.empty_like(field)
        taken = bench.seconds(lambda: other.copy_(field))
        bench.add(figure="copy, read and written", gb_per_s=2 * field.numel() * 4 / taken / 1e9)
    with bench.attempt(figure="multiply-adds"):
        side = 256 if bench.fast else 8192
        left = torch.rand(side, side, device=bench.device)
        taken = bench.seconds(lambda: left @ left)
        bench.add(figure="matrix product, float32", tflop_per_s=2 * side**3 / taken / 1e12)
    with bench.attempt(figure="launch"):
        little = torch.zeros(8, device=bench.device)
        bench.add(figure="one small operation", microseconds=1e6 * bench.seconds(lambda: little.add_(1.0), least=0.05))


def tests(bench: Bench) -> None:
    """How many tests pass, file by file; on a CPU one file stands for all."""
    files = ON_DEVICE if bench.cuda else ON_DEVICE[1:2]
    for file in files:
        with bench.attempt(file=file):
            command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", file]
            told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout
            counts = {kind: int(n) for n, kind in re.findall(r"(\d+) (passed|failed|skipped|errors?)", told)}
            failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", told, re.MULTILINE)
            if not counts:
                print(told, file=sys.stderr)
            bench.add(file=file, **counts, which_failed=failed)
