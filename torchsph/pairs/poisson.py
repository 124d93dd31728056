"""The pressure Poisson equation on particles: matrix-free conjugate gradients, all members side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# below this a diagonal entry belongs to a particle without neighbours, whose equation says nothing
_ALONE = 1e-12
_TINY = torch.finfo(torch.float64).tiny
# iterations between two looks at whether any member is still at it: each look makes the processor wait for a GPU, and
# more iterations change nothing in members that are done
_LOOK_EVERY = 8


@dataclass(frozen=True)
class PoissonSolution:
    """What the solver found, and how; all but ``values`` per member.

    Attributes:
        values: (N,), 0 on particles that are not free.
        iterations: (members,) int64. residual: (members,) norm relative to the source's.
        converged: (members,) bool.
        mismatch: (members,) mean of the source, taken out where the constant is in the null space: no pressure can
            answer it (a closed cavity whose volume changes).
    """

    values: Tensor
    iterations: Tensor
    residual: Tensor
    converged: Tensor
    mismatch: Tensor


@dataclass(frozen=True)
class PoissonProblem:
    """A u = source on the particles that are ``free``; the others hold 0.

    Attributes:
        apply: A on (N,): symmetric and not negative in the sum over weight a b.
        diagonal: (N,) of A. weight: (N,), positive, the particles' volumes.
        free: (N,) bool. singular: (members,) bool, members where A has the constant in its null space.
        member: (N,) int64. members: their number.
    """

    apply: Callable[[Tensor], Tensor]
    diagonal: Tensor
    weight: Tensor
    free: Tensor
    singular: Tensor
    member: Tensor
    members: int

    def total(self, values: Tensor) -> Tensor:
        """Sum of (N,) over each member, (members,) float64."""
        out = torch.zeros(self.members, dtype=torch.float64, device=values.device)
        return out.index_add_(0, self.member, values.double())

    def spread(self, values: Tensor, like: Tensor) -> Tensor:
        """(members,) given to every particle, (N,) of the type of ``like``."""
        return values.to(like.dtype).index_select(0, self.member)

    def image(self, values: Tensor) -> Tensor:
        """A ``values`` on free particles, 0 elsewhere."""
        return torch.where(self.free, self.apply(values), torch.zeros_like(values))


def solve(
    problem: PoissonProblem, source: Tensor, start: Tensor | None, *, tolerance: float, iterations: int
) -> PoissonSolution:
    """Conjugate gradients with the diagonal as preconditioner, each member until its own residual is small.

    The compiled solver (csrc/poisson.hpp) has a coarse level beside it: the same answer from half of the iterations.

    Sums run in double precision, the rest in that of ``source``. A member that is done, or whose numbers are not
    finite, is left as it is while the others go on.

    Args:
        source: (N,). start: (N,) or None for 0. tolerance: of the residual relative to the source.
    """
    p, zero = problem, torch.zeros_like(source)
    mass = torch.where(p.free, p.weight, zero)
    mean = p.total(mass * source) / p.total(mass).clamp_min(_TINY)
    mean = torch.where(p.singular, mean, torch.zeros_like(mean))
    source = torch.where(p.free, source - p.spread(mean, source), zero)
    inverse = torch.where(p.diagonal > _ALONE, 1.0 / p.diagonal.clamp_min(_ALONE), zero)
    values, residual = zero, source
    if start is not None:
        values = torch.where(p.free, start, zero)
        residual = source - p.image(values)
    scale = p.total(mass * source * source)
    wanted = tolerance**2 * scale
    left = begun = p.total(mass * residual * residual)
    count, begin = torch.zeros(p.members, dtype=torch.int64, device=source.device), values
    active, direction, old = left > wanted, zero, torch.ones_like(left)
    every = 1 if source.device.type == "cpu" else _LOOK_EVERY
    for number in range(iterations):
        if number % every == 0 and not bool(active.any()):
            break
        pre = inverse * residual
        new = p.total(mass * residual * pre)
        beta = torch.where(count > 0, new / old.clamp_min(_TINY), torch.zeros_like(new))
        direction, old = pre + p.spread(beta, pre) * direction, new
        image = p.image(direction)
        curvature = p.total(mass * direction * image)
        active = active & (curvature > 0)
        along = p.spread(torch.where(active, new / curvature.clamp_min(_TINY), torch.zeros_like(new)), pre)
        values, residual = values + along * direction, residual - along * image
        count = count + active
        left = p.total(mass * residual * residual)
        active = active & (left > wanted) & torch.isfinite(left)
    # where the residual has grown, as it may on a system without a solution, the start is the better answer
    worse = torch.isfinite(begun) & ~(left <= begun)
    values = torch.where(worse.index_select(0, p.member), begin, values)
    left = torch.where(worse, begun, left)
    relative = torch.sqrt(left / scale.clamp_min(_TINY))
    return PoissonSolution(values, count, relative, left <= wanted, mean)
