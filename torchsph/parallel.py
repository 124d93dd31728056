"""Processes that torchrun started: who leads, on which device, the group that joins them, and work that they share."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import torch.distributed as dist

T = TypeVar("T")


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
    dist.init_process_group("gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


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


def from_last(value: T) -> T:
    """What the last process holds, in every process."""
    if not dist.is_initialized():
        return value
    held = [value]
    dist.broadcast_object_list(held, dist.get_world_size() - 1)
    return held[0]
