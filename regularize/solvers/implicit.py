"""Gradients through the fit, by the implicit adjoint.

The coefficients solve M x = A' b with M = A'A + damping^2 I. For a loss with gradient g the adjoint z solves
M z = g with the same factor; then, for a row of weight w and unweighted values s with weighted target
b = w t, dL/db = w (s.z) and dL/dw = b (s.z) - 2 w (s.x)(s.z) at fixed b. No iteration is unrolled.
"""

from dataclasses import replace
from typing import Any

import torch

from regularize.rows.operators import System, VectorRows

from .direct import solve_direct
from .interface import CholeskyFactor, Solution, Solved
from .prepared import PreparedSystem


class _ImplicitSolve(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        weight: torch.Tensor,
        target: torch.Tensor,
        block: VectorRows,
        solution: Solution,
        factor: CholeskyFactor,
        prepared: PreparedSystem,
    ) -> torch.Tensor:
        ctx.save_for_backward(weight, target)
        ctx.block, ctx.solution, ctx.factor, ctx.prepared = block, solution, factor, prepared
        return solution.x.clone()

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        weight, target = ctx.saved_tensors
        prepared, plain = ctx.prepared, ctx.block.with_unit_weight()
        shape = (prepared.system.knots.nodes, prepared.system.components)
        adjoint = prepared.expand(ctx.factor.solve(gradient.view(shape)[prepared.ordering.nodes]))
        pulled, fitted = plain.matvec(adjoint), plain.matvec(ctx.solution.x.view(shape))
        flat = weight.double().flatten()
        by_weight = target * pulled - 2.0 * flat * fitted * pulled
        by_target = flat * pulled
        return by_weight.view(weight.shape).to(weight), by_target.to(target), None, None, None, None


def solve_with_gradient(system: System, tolerance: float, strict: bool = True) -> Solved:
    """As :func:`regularize.solve_direct`, keeping the graph to the first block's weights and targets.

    The first block must be VectorRows (full-vector samples); the other blocks are constants.
    """
    block = system.blocks[0]
    if not isinstance(block, VectorRows):
        raise TypeError(f"gradients need full-vector samples as first rows, not {type(block).__name__}")
    still = System(system.knots, system.components, [block.detached(), *system.blocks[1:]], system.damping)
    prepared = PreparedSystem(still)
    solution, factor = solve_direct(prepared, tolerance=tolerance, strict=strict)
    x = _ImplicitSolve.apply(block.weight, block.target, still.blocks[0], solution, factor, prepared)
    return Solved(replace(solution, x=x), factor)
