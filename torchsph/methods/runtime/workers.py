"""Workers: further processes on this machine that share a run with this one, each of one thread.

They are started anew, by this Python, and import the package: nothing is forked from a process with threads, and the
caller's own program is not run again. All processes call the same function (``shared`` parts the work); this one leads:
it alone writes, prints, hears signals and returns a result. A worker lives as long as this process holds a pipe to it.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import torch
import torch.distributed as dist

from torchsph.assimilation.distributed import PeerLost

from . import parallel
from .cores import usable_cores

T = TypeVar("T")

MOST_WORKERS = 1024
# s: between two looks for workers; to find out which one has gone
PAUSE, _INQUEST = 0.02, 5.0
# files in the folder that a run's processes share
CALL, STORE, HERE, FAULT = "call", "store", "here-{}", "fault-{}"
# exit code of a worker that another one has left
BEREFT = 76

_living: list[subprocess.Popen[bytes]] = []


class LostWorker(RuntimeError):
    """A worker has ended before its work was done, without a word."""


class KilledWorker(LostWorker, MemoryError):
    """A worker was killed; where nobody did it, the system has, for want of memory."""


def spread(lead: Callable[[], T], worker: Callable[[], object], workers: int) -> T:
    """The result of a function that shares its work with further processes; the same for any number of them.

    Args:
        lead: is called here.
        worker: is called in each of the others: the same function, of a module, with arguments that can be pickled,
            and without what the lead alone does.
        workers: how many processes there are, this one among them.

    Returns:
        What ``lead`` returns.

    Raises:
        LostWorker: a worker was killed or has crashed.
        Exception: whatever the work raised, here or in a worker.
    """
    if workers == 1:
        return lead()
    if parallel.processes() > 1 or parallel.under_torchrun():
        raise ValueError("workers: the processes of this run are there already (torchrun); leave workers at 1")
    with tempfile.TemporaryDirectory(prefix="torchsph-", ignore_cleanup_errors=True) as name, one_thread():
        folder = Path(name)
        with _Workers(folder, workers) as others:
            with (folder / "making").open("wb") as file:
                pickle.dump(worker, file, pickle.HIGHEST_PROTOCOL)
            (folder / "making").rename(folder / CALL)
            store = dist.FileStore(str(folder / STORE), workers)
            group = parallel.Group(0, workers, store, others.met, local=True)
            try:
                with parallel.within(group):
                    return lead()
            except PeerLost as lost:
                raise others.fault() from lost


def chosen_workers(asked: int | None, tasks: int, most: Callable[[int], bool] = lambda count: True) -> int:
    """How many processes share a run.

    Args:
        asked: by the caller; None: as many as there are cores for this process, and work for them.
        tasks: that can be done at the same time.
        most: whether so many have room beside one another.

    Raises:
        ValueError: workers were asked for where there are processes already.
    """
    if parallel.is_worker():
        return 1
    if parallel.under_torchrun() or not dist.is_available():
        if asked is not None and asked > 1:
            raise ValueError("workers: torchrun has started the processes of this run already; leave workers out")
        return 1
    if asked is not None:
        return asked
    return next(count for count in range(max(1, min(usable_cores(), tasks)), 0, -1) if count == 1 or most(count))


def memory_of_workers() -> tuple[int, int]:
    """Bytes that the workers of this process take now, and at most so far."""
    now = peak = 0
    for process in _living:
        try:
            text = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii", errors="replace")
        except OSError:  # it has ended, or there is no /proc
            continue
        sizes = {line.partition(":")[0]: line.split()[1] for line in text.splitlines() if line.startswith("Vm")}
        now, peak = now + 1024 * int(sizes.get("VmRSS", 0)), peak + 1024 * int(sizes.get("VmHWM", 0))
    return now, peak


def meeting(folder: Path, rank: int, count: int) -> Iterator[None]:
    """Tell the others that this process has come to the first exchange, and look, again and again, until all have."""
    (folder / HERE.format(rank)).touch()
    missing = [folder / HERE.format(other) for other in range(count)]
    while missing := [path for path in missing if not path.exists()]:
        yield
        time.sleep(PAUSE)


@contextmanager
def one_thread() -> Iterator[None]:
    """This process has one thread meanwhile, as its workers have."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _Workers:
    """The other processes of a run, from their start to their end.

    Args:
        folder: that all processes share, empty.
        count: of all processes, this one among them.
    """

    def __init__(self, folder: Path, count: int) -> None:
        self.folder, self.count = folder, count
        self.processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> _Workers:
        if not sys.executable:
            raise ValueError("workers: this program is no Python that could start another; leave workers at 1")
        one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        path = os.pathsep.join(str(Path(entry or os.getcwd())) for entry in sys.path)
        environment = os.environ | one | {"OMP_WAIT_POLICY": "PASSIVE", "PYTHONPATH": path}
        call = [sys.executable, "-P", "-m", "torchsph.methods.runtime.worker", str(self.folder), str(self.count)]
        try:
            for rank in range(1, self.count):
                self.processes.append(
                    subprocess.Popen(
                        [*call, str(rank)], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, env=environment
                    )
                )
        except BaseException:
            self._end()
            raise
        _living.extend(self.processes)
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        self._end()

    def met(self) -> None:
        """Return when this process and all workers have come to their first exchange.

        Raises:
            PeerLost: one of them has ended instead.
        """
        for _ in meeting(self.folder, 0, self.count):
            if any(process.poll() is not None for process in self.processes):
                raise PeerLost("a worker has ended before its first exchange")

    def fault(self) -> Exception:
        """What has become of the worker that was lost: its own fault, where it could still tell it."""
        end = time.monotonic() + _INQUEST
        while time.monotonic() < end:
            for told in (self.folder / FAULT.format(rank) for rank in range(1, self.count)):
                if told.exists():
                    found: Exception = pickle.loads(told.read_bytes())
                    return found
            for rank, process in enumerate(self.processes, 1):
                if process.poll() not in (None, BEREFT):
                    return self._ended(rank, process.returncode)
            time.sleep(PAUSE)
        return LostWorker("a worker cannot be reached; try --workers 1")

    def _ended(self, rank: int, code: int) -> LostWorker:
        name = f"worker {rank} of {self.count - 1} beside this process"
        if code == -signal.SIGKILL:
            return KilledWorker(
                f"{name} was killed (SIGKILL), most likely because memory ran out; try fewer --workers, and --resume "
                "where there is a checkpoint"
            )
        how = f"crashed ({signal.Signals(-code).name})" if code < 0 else f"ended with code {code}"
        return LostWorker(f"{name} {how}; try --workers 1")

    def _end(self) -> None:
        """End the workers: their work is done, or there is no use for it."""
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
            if process in _living:
                _living.remove(process)
