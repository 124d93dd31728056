"""Members spread over processes: each advances its own, all make the same analysis.

What is costly is the model, and it needs no communication. An analysis needs the predicted observations of
all members, and its result mixes all states; both are gathered (tens of megabytes for a velocity grid),
every process computes the same analysis from the same numbers and keeps its own members. The result is
therefore the same bit for bit whatever the number of processes, provided that each passes a generator in
the same state.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import torch
import torch.distributed as dist
from torch import Tensor

from .errors import AssimilationError
from .filters.base import Analysis, Filter
from .observations import Observations, Screened

# s between two looks for what other processes send: a share of what was waited already, at least and at most
_NAP, _OF_THE_WAIT, _LONGEST_NAP = 5e-5, 0.02, 5e-2


class PeerLost(RuntimeError):
    """Another process has gone, or cannot be reached."""


def arrived(work: dist.Work) -> None:
    """Wait for an exchange in naps, between which a request to stop is heard.

    Raises:
        PeerLost: one of the processes has gone.
    """
    began = time.monotonic()
    while not work.is_completed():
        time.sleep(min(max(_OF_THE_WAIT * (time.monotonic() - began), _NAP), _LONGEST_NAP))
    try:
        work.wait()
    except RuntimeError as fault:
        raise PeerLost(f"another process of the run has gone: {fault}") from fault


def member_slice(total: int, rank: int, processes: int) -> slice:
    """The members of process `rank`: contiguous, in order, numbers differing by one at most."""
    if not 0 <= rank < processes or total < processes:
        raise AssimilationError(
            f"{total} members cannot be spread over {processes} processes with one of rank {rank}: "
            "every process needs at least one member"
        )
    return slice(total * rank // processes, total * (rank + 1) // processes)


@dataclass(frozen=True)
class Distributed:
    """A `Filter` of the whole ensemble that every process calls with its own members.

    `analyse` returns the whole ensemble's mean, variance and record, and the process's own members. Ranks
    hold the members of `member_slice`; all must call. `group` as in `torch.distributed`: gloo on CPU, NCCL
    on CUDA.
    """

    filter: Filter
    group: dist.ProcessGroup | None = None

    def analyse(
        self,
        ensemble: Tensor,
        predicted: Tensor,
        observations: Observations,
        *,
        state_positions: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Analysis:
        """See `Filter.analyse`; `ensemble (k, n)` and `predicted (k, m)` of this process's members."""
        counts = _counts(len(ensemble), ensemble.device, self.group)
        rank = dist.get_rank(self.group)
        start = sum(counts[:rank])
        analysis = self.filter.analyse(
            gather_members(ensemble, counts, self.group),
            gather_members(predicted, counts, self.group),
            observations,
            state_positions=state_positions,
            generator=generator,
        )
        return replace(analysis, ensemble=analysis.ensemble[start : start + counts[rank]])

    def screen(self, ensemble: Tensor, predicted: Tensor, observations: Observations) -> Screened:
        """See `Filter.screen`; the same in every process."""
        counts = _counts(len(ensemble), ensemble.device, self.group)
        states, everyone = (gather_members(part, counts, self.group) for part in (ensemble, predicted))
        return self.filter.screen(states, everyone, observations)


def gather_members(members: Tensor, counts: list[int], group: dist.ProcessGroup | None = None) -> Tensor:
    """`(sum of counts, ...)` from each process's `(counts[rank], ...)`, in the order of ranks."""
    # Collectives want equal shapes: pad to the largest share, cut again.
    padded = members.new_zeros(max(counts), *members.shape[1:])
    padded[: len(members)] = members
    parts = [torch.empty_like(padded) for _ in counts]
    arrived(dist.all_gather(parts, padded, group=group, async_op=True))
    return torch.cat([part[:count] for part, count in zip(parts, counts, strict=True)])


def _counts(own: int, device: torch.device, group: dist.ProcessGroup | None) -> list[int]:
    mine = torch.tensor([own], device=device)
    parts = [torch.empty_like(mine) for _ in range(dist.get_world_size(group))]
    arrived(dist.all_gather(parts, mine, group=group, async_op=True))
    return [int(part) for part in parts]
