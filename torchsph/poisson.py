"""The pressure Poisson equation on particles: matrix-free conjugate gradients, all members side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# a preconditioner needs a diagonal: particles without a neighbour keep their pressure
_TINY = 1e-12


@dataclass(frozen=True)
class PoissonSolution:
    """Pressure (N,) and how the solver got there, per member.

    Attributes:
        iterations: (members,) int64. residual: (members,) relative to the source. converged: (members,) bool.
        mismatch: (members,) mean of the source, which no pressure can answer where no particle's pressure is given;
            it has been taken out.
    """

    pressure: Tensor
    iterations: Tensor
    residual: Tensor
    converged: Tensor
    mismatch: Tensor


@dataclass(frozen=True)
class PoissonProblem:
    """A u = source on the particles that are ``free``; the others hold pressure 0 or take no part.

    Attributes:
        apply: A on (N,), symmetric and not negative under the weight. diagonal: (N,) of A.
        weight: (N,) particle volumes: A is symmetric in the sum over weight a b.
        free: (N,) bool. singular: (members,) bool: members where A has the constant as null space.
    """

    apply: Callable[[Tensor], Tensor]
    diagonal: Tensor
    weight: Tensor
    free: Tensor
    singular: Tensor
    member: Tensor
    members: int

    def total(self, values: Tensor) -> Tensor:
        """Sum over each member in double precision, (members,)."""
        out = torch.zeros(self.members, dtype=torch.float64, device=values.device)
        return out.index_add_(0, self.member, values.double())

    def spread(self, values: Tensor, like: Tensor) -> Tensor:
        """(members,) given to every particle, (N,)."""
        return values.to(like.dtype).index_select(0, self.member)


def solve(
    problem: PoissonProblem, source: Tensor, start: Tensor, *, tolerance: float, iterations: int
) -> PoissonSolution:
    """Solve by conjugate gradients with the diagonal as preconditioner, each member until its own residual is small.

    Args:
        source, start: (N,). tolerance: of the residual relative to the source. iterations: at most.

    A member that does not converge keeps what it has and is marked; one with a non-finite residual stops at once.
    """
    p = problem
    zero = torch.zeros_like(source)
    source = torch.where(p.free, source, zero)
    mass = torch.where(p.free, p.weight, zero)
    mean = p.total(mass * source) / p.total(mass).clamp_min(_TINY)
    mean = torch.where(p.singular, mean, torch.zeros_like(mean))
    source = torch.where(p.free, source - p.spread(mean, source), zero)
    pressure = torch.where(p.free, start, zero)
    inverse = torch.where(p.free & (p.diagonal > _TINY), 1.0 / p.diagonal.clamp_min(_TINY), zero)
    residual = torch.where(p.free, source - p.apply(pressure), zero)
    scale = p.total(mass * source * source)
    wanted = tolerance**2 * scale
    count = torch.zeros(p.members, dtype=torch.int64, device=source.device)
    direction, old = zero, torch.ones_like(scale)
    left = p.total(mass * residual * residual)
    active = left > wanted
    for _ in range(iterations):
        if not bool(active.any()):
            break
        pre = inverse * residual
        new = p.total(mass * residual * pre)
        beta = torch.where(count > 0, new / old.clamp_min(1e-300), torch.zeros_like(new))
        direction = pre + p.spread(beta, pre) * direction
        image = torch.where(p.free, p.apply(direction), zero)
        curvature = p.total(mass * direction * image)
        active = active & (curvature > 0)
        alpha = torch.where(active, new / curvature.clamp_min(1e-300), torch.zeros_like(new))
        along = p.spread(alpha, pre)
        pressure, residual = pressure + along * direction, residual - along * image
        old = new
        count += active
        left = p.total(mass * residual * residual)
        active = active & (left > wanted) & torch.isfinite(left)
    relative = torch.sqrt(left / scale.clamp_min(1e-300))
    return PoissonSolution(pressure, count, relative, left <= wanted, mean)
