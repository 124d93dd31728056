"""The program of a worker: `python -m torchsph.methods.runtime.worker FOLDER PROCESSES RANK`, started by `workers.py`.

It takes its part in one call, and ends with it, or as soon as the process that started it is gone. Requests to stop are
for that process: signals, which a terminal or a scheduler may send to all of them, are left to it.
"""

from __future__ import annotations

import os
import pickle
import shutil
import signal
import sys
import threading
import time
import warnings
from pathlib import Path

import torch
import torch.distributed as dist

from torchsph.assimilation.distributed import PeerLost

from . import parallel
from .workers import BEREFT, CALL, FAULT, PAUSE, STORE, meeting


def main(folder: Path, processes: int, rank: int) -> None:
    """Take part as process ``rank`` of so many; never returns."""
    for one in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1):
        signal.signal(one, signal.SIG_IGN)
    threading.Thread(target=_end_with_lead, args=(folder,), daemon=True).start()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # said by every process alike; what one task says is handed on with its result
    try:
        while not (folder / CALL).exists():
            time.sleep(PAUSE)
        with (folder / CALL).open("rb") as file:
            call = pickle.load(file)
        store = dist.FileStore(str(folder / STORE), processes)
        group = parallel.Group(rank, processes, store, lambda: list(meeting(folder, rank, processes)), local=True)
        with parallel.within(group):
            call()
            signal.pause()  # until the lead has what it waits for, and ends this process
    except PeerLost:  # another one has the fault, and tells it
        os._exit(BEREFT)
    except BaseException as fault:
        making = folder / f"making-{rank}"
        making.write_bytes(_told(fault))
        making.rename(folder / FAULT.format(rank))
        os._exit(1)


def _end_with_lead(folder: Path) -> None:
    """End this process when the lead's end of its standard input is closed, whatever it is at.

    The lead ends its workers before it closes anything: it was killed, and the folder is left to them.
    """
    while os.read(0, 1):
        pass
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def _told(fault: BaseException) -> bytes:
    """An exception for another process, as one that it surely knows where its own kind does not travel."""
    try:
        packed = pickle.dumps(fault)
        pickle.loads(packed)
        return packed
    except Exception:
        return pickle.dumps(RuntimeError(f"{type(fault).__name__}: {fault}"))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
