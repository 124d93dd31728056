"""Powers of complex samples and their sums over windows of nodes."""

from __future__ import annotations

import torch
from torch import Tensor


def power(samples: Tensor) -> Tensor:
    """|samples|^2 of complex samples, without the square root that ``abs`` takes (several times faster)."""
    parts = torch.view_as_real(samples.resolve_conj())
    return torch.addcmul(parts[..., 0].square(), parts[..., 1], parts[..., 1])


def box_sum(field: Tensor, nodes: int, axis: int) -> Tensor:
    """Sums over windows of nodes along one axis, zeros outside.

    Windows of 1, 2, 4, ... nodes by doubling, joined: additions alone, and log2(nodes) of them.

    Args:
        field: of any shape, real or complex.
        nodes: of the window, an odd number.
        axis: along which it lies.
    """
    size = field.shape[axis]
    edge = list(field.shape)
    edge[axis] = nodes // 2
    run, width = torch.cat([field.new_zeros(edge), field, field.new_zeros(edge)], axis), 1
    total, start = run.narrow(axis, 0, size).clone(), 1  # the number is odd: the window of one node is needed
    nodes >>= 1
    while nodes:
        rest = run.shape[axis] - width
        run, width = run.narrow(axis, 0, rest) + run.narrow(axis, width, rest), 2 * width
        if nodes & 1:
            total.add_(run.narrow(axis, start, size))
            start += width
        nodes >>= 1
    return total
