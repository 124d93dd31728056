"""Processes that torchrun started: who leads, on which device, and the group that joins them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch.distributed as dist


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
