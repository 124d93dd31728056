"""Processes that share a run: those that torchrun started, or workers of this one; who leads, and how they exchange."""

from __future__ import annotations

import os
import pickle
import time
import uuid
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any, Generic, Protocol, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed.distributed_c10d import _set_pg_timeout

from torchsph.assimilation.distributed import arrived

from .loopback import over_loopback

T = TypeVar("T")
A = TypeVar("A")
B = TypeVar("B")

# s between two looks for processes that have not come yet
_PAUSE = 0.02
# for how long processes on one machine wait for one that works: one that is gone is noticed at once all the same
_PATIENCE = timedelta(days=30)
# until processes that have come must have met
_MEETING = timedelta(minutes=1)


@dataclass
class Group:
    """Processes that share a run; they meet at their first exchange, and work on their own until then.

    Attributes:
        rank: of this process. processes: how many there are.
        store: which all of them write to and read from.
        ready: returns when all processes have come to their first exchange.
        local: whether all are on this machine, started by the first of them.
        rounds: lists of tasks that they have shared so far.
    """

    rank: int
    processes: int
    store: dist.Store
    ready: Callable[[], object] = lambda: None
    local: bool = False
    rounds: int = field(default=0, init=False)

    def meet(self) -> None:
        """Make the process group, where it is not there yet.

        Grids are gathered from the memory of the hosts by gloo, whatever device the simulations run on: they are a few
        megabytes in a cycle, next to seconds of simulation.
        """
        if dist.is_initialized():
            return
        self.ready()
        store = dist.PrefixStore("meeting", self.store)
        with over_loopback(self.local):
            timeout = _MEETING if self.local else None
            dist.init_process_group("gloo", store=store, rank=self.rank, world_size=self.processes, timeout=timeout)
        if self.local:
            _set_pg_timeout(_PATIENCE)


_group: Group | None = None


@contextmanager
def within(group: Group) -> Iterator[None]:
    """This process is one of a group meanwhile."""
    global _group
    _group = group
    try:
        yield
    finally:
        _group = None
        if dist.is_initialized():
            dist.destroy_process_group()


def processes() -> int:
    """How many share the run."""
    if _group is not None:
        return _group.processes
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """The number of this process among them, from 0."""
    if _group is not None:
        return _group.rank
    return dist.get_rank() if dist.is_initialized() else 0


def is_worker() -> bool:
    """Whether another process on this machine has started this one, and answers for it."""
    return _group is not None and _group.local and _group.rank > 0


def under_torchrun() -> bool:
    """Whether torchrun has started several processes, or the caller has joined some."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1 or dist.is_initialized()


def is_lead() -> bool:
    """Whether this process writes and prints: the first of a group or of those of torchrun, or the only one."""
    return rank() == 0 if processes() > 1 else int(os.environ.get("RANK", "0")) == 0


def own_device(name: str) -> str:
    """The device of this process: "cuda" means one GPU each where several processes share a machine."""
    local = os.environ.get("LOCAL_RANK")
    return f"cuda:{local}" if name == "cuda" and local is not None else name


@contextmanager
def joined() -> Iterator[None]:
    """The group of a run under torchrun; nothing without it."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        yield
        return
    store, own, count = next(dist.rendezvous("env://"))
    group = Group(own, count, dist.PrefixStore(_round(store, own, count), store))
    with within(group):
        group.meet()
        yield


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
    return rank() == processes() - 1


class Bar(Protocol):
    """A progress bar as tqdm has it: ``n`` of ``total`` are done."""

    n: float
    total: float

    def update(self, n: float = 1) -> object:
        """So many more are done."""


def advanced(bar: Bar) -> None:
    """Move a bar on for one task of this process, and for those that the others have done meanwhile, as it seems."""
    bar.update(min(processes(), bar.total - bar.n))


# --- exchanges: every process has to call them, in the same order ----------------------------------


def shared(tasks: Sequence[Callable[[], T]], *, taken_over: bool = True) -> list[T]:
    """The results of independent tasks, each done by one process and told to all.

    Each process begins with a stretch of its own, because neighbours often have something in common, and who is free
    takes what nobody has begun, so that none waits long for another that the machine holds up. No task may change what
    another one, or what comes after, depends on: what it changes is changed in one process alone. Every process has to
    call this, with tasks of the same number and meaning.

    Args:
        tasks: the work.
        taken_over: whether a process that is free takes tasks of another's stretch; not where what these have in common
            would have to be made anew.
    """
    if processes() == 1:
        return [task() for task in tasks]
    done: dict[int, _Done[T]] = {}
    for own in _told_to_all({k: _done(tasks[k]) for k in _taken(len(tasks), taken_over)}):
        done |= own
    for k in range(len(tasks)) if is_lead() else ():
        for text, kind in done[k].warned:
            warnings.warn(text, kind, stacklevel=2)
    return [done[k].result for k in range(len(tasks))]


@dataclass(frozen=True)
class _Done(Generic[T]):
    """The result of a task, and what it has warned of in a process that nobody listens to."""

    result: T
    warned: list[tuple[str, type[Warning]]]


def _done(task: Callable[[], T]) -> _Done[T]:
    if not is_worker():
        return _Done(task(), [])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        result = task()
    return _Done(result, [(str(one.message), one.category) for one in told])


def _taken(count: int, over: bool) -> Iterator[int]:
    """Numbers of the tasks that this process is to do, each claimed when the one before is done."""
    group = _group
    if not over:
        yield from _stretch(count, rank(), processes())
        return
    if group is None:  # a process group of the caller's, whose store nobody knows: in turn
        yield from range(rank(), count, processes())
        return
    group.rounds += 1
    for number in _order(count, group.rank, group.processes):
        if group.store.add(f"task/{group.rounds}/{number}", 1) == 1:
            yield number


def _order(count: int, own: int, group: int) -> list[int]:
    """In which order a process of a group looks for tasks: its own stretch, then what the others come to last."""
    stretch = _stretch(count, own, group)
    return [*stretch, *reversed([*range(stretch.stop, count), *range(stretch.start)])]


def _stretch(count: int, own: int, group: int) -> range:
    """The tasks of a process of a group, as many as those of any other."""
    return range(count * own // group, count * (own + 1) // group)


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
    return _told_by(processes() - 1, value)


def from_lead(value: T) -> T:
    """What the first process holds, in every process."""
    return _told_by(0, value)


def anywhere(wish: bool) -> bool:
    """Whether any process wishes it, told to all; every process has to ask."""
    if processes() == 1:
        return wish
    wished = torch.tensor([int(wish)])
    meet()
    arrived(dist.all_reduce(wished, dist.ReduceOp.MAX, async_op=True))
    return bool(wished.item())


def meet() -> None:
    """See ``Group.meet``; nothing for a single process."""
    if _group is not None:
        _group.meet()


def _told_by(source: int, value: T) -> T:
    """What one process holds, in every process."""
    if processes() == 1:
        return value
    meet()
    packed = _packed(value) if rank() == source else torch.empty(0, dtype=torch.uint8)
    size = torch.tensor([len(packed)])
    arrived(dist.broadcast(size, source, async_op=True))
    if rank() != source:
        packed = torch.empty(int(size), dtype=torch.uint8)
    arrived(dist.broadcast(packed, source, async_op=True))
    return value if rank() == source else _unpacked(packed)


def _told_to_all(value: T) -> list[T]:
    """What each process holds, in the order of ranks, in every process."""
    meet()
    packed = _packed(value)
    sizes = [torch.empty(1, dtype=torch.int64) for _ in range(processes())]
    arrived(dist.all_gather(sizes, torch.tensor([len(packed)]), async_op=True))
    longest = max(int(size) for size in sizes)
    padded = torch.cat([packed, packed.new_zeros(longest - len(packed))])
    parts = [torch.empty_like(padded) for _ in sizes]
    arrived(dist.all_gather(parts, padded, async_op=True))
    return [_unpacked(part[: int(size)]) for part, size in zip(parts, sizes, strict=True)]


def _packed(value: object) -> Tensor:
    return torch.frombuffer(bytearray(pickle.dumps(value, pickle.HIGHEST_PROTOCOL)), dtype=torch.uint8)


def _unpacked(packed: Tensor) -> Any:
    return pickle.loads(packed.numpy().data)
