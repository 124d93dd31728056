"""Processes that torchrun started: who leads, on which device, the group that joins them, and work that they share."""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
import torch.distributed as dist

T = TypeVar("T")
A = TypeVar("A")
B = TypeVar("B")

# s between two looks for processes that have not come yet
_PAUSE = 0.02


def is_lead() -> bool:
    """Whether this process writes and prints: the first of those that torchrun started, or the only one."""
    return int(os.environ.get("RANK", "0")) == 0


def own_device(name: str) -> str:
    """The device of this process: "cuda" means one GPU each where several processes share a machine."""
    local = os.environ.get("LOCAL_RANK")
    return f"cuda:{local}" if name == "cuda" and local is not None else name


@contextmanager
def joined() -> Iterator[None]:
    """The process group of a run under torchrun; nothing without it.

    Grids are gathered from the memory of the hosts by gloo, whatever device the simulations run on: they are a few
    megabytes in a cycle, next to seconds of simulation.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        yield
        return
    store, rank, processes = next(dist.rendezvous("env://"))
    fresh = dist.PrefixStore(_round(store, rank, processes), store)
    dist.init_process_group("gloo", store=fresh, rank=rank, world_size=processes)
    try:
        yield
    finally:
        dist.destroy_process_group()


def _round(store: dist.Store, rank: int, processes: int) -> str:
    """A name that all processes of this start share, and that no earlier start has used.

    torchrun keeps one store for all its restarts, and gloo would find the addresses of processes that are gone in it.
    How often it has restarted does not tell one start from another: on two nodes only the one that failed counts.
    So the first process answers each of the others under a name that only this one can have chosen.
    """
    own = uuid.uuid4().hex
    if rank:
        store.set(f"torchsph/hello/{rank}", own)
        name = store.get(f"torchsph/answer/{own}").decode()
        store.set(f"torchsph/here/{name}/{rank}", own)
        return name
    missing = set(range(1, processes))
    while missing:
        for other in sorted(missing):
            # which may still be what an earlier start has left behind: then nobody waits for the answer
            asked = store.get(f"torchsph/hello/{other}").decode()
            store.set(f"torchsph/answer/{asked}", own)
        missing = {other for other in missing if not store.check([f"torchsph/here/{own}/{other}"])}
        time.sleep(_PAUSE)
    return own


def is_last() -> bool:
    """Whether this is the last process of the group, which does what the first has no time for; or the only one."""
    return not dist.is_initialized() or dist.get_rank() == dist.get_world_size() - 1


def shared(tasks: Sequence[Callable[[], T]]) -> list[T]:
    """The results of independent tasks, each done by one process and told to all.

    Task k is that of process k modulo their number; without a process group there is one process. No task may change
    what another one, or what comes after, depends on: what it changes is changed in one process alone. Every process
    has to call this, with tasks of the same number and meaning.
    """
    if not dist.is_initialized():
        return [task() for task in tasks]
    rank, processes = dist.get_rank(), dist.get_world_size()
    parts: list[list[T]] = [[] for _ in range(processes)]
    dist.all_gather_object(parts, [task() for task in tasks[rank::processes]])
    return [parts[k % processes][k // processes] for k in range(len(tasks))]


def shared_pair(first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
    """The results of two tasks of different types; see ``shared``."""
    tasks: list[Callable[[], Any]] = [first, second]
    one, other = shared(tasks)
    return one, other


def forked(generator: torch.Generator) -> torch.Generator:
    """A generator of its own for what one process alone may do; the one given moves on by one number in all."""
    return torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=generator)))


def from_last(value: T) -> T:
    """What the last process holds, in every process."""
    if not dist.is_initialized():
        return value
    held = [value]
    dist.broadcast_object_list(held, dist.get_world_size() - 1)
    return held[0]


def anywhere(wish: bool) -> bool:
    """Whether any process wishes it, told to all; every process has to ask."""
    if not dist.is_initialized():
        return wish
    wished = torch.tensor([int(wish)])
    dist.all_reduce(wished, dist.ReduceOp.MAX)
    return bool(wished.item())
