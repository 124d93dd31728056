"""Arithmetic of short vectors, and of coefficients that members have each for themselves."""

from __future__ import annotations

from typing import overload

import torch
from torch import Tensor


@overload
def per_particle(value: Tensor, member: Tensor) -> Tensor:
    """One value for each particle."""


@overload
def per_particle(value: float, member: Tensor) -> float:
    """One value for each particle."""


@overload
def per_particle(value: float | Tensor, member: Tensor) -> float | Tensor:
    """One value for each particle."""


def per_particle(value: float | Tensor, member: Tensor) -> float | Tensor:
    """A coefficient given per member, (members,), spread over the particles (N,); a float stays a float."""
    return value.index_select(0, member) if isinstance(value, Tensor) and value.ndim else value


def column(value: float | Tensor) -> float | Tensor:
    """A factor of each particle, (N,), made to multiply vectors (N, D); a float stays a float."""
    return value[:, None] if isinstance(value, Tensor) else value


def inner(first: Tensor, second: Tensor) -> Tensor:
    """Inner products (N,) of vectors (N, D), column by column: less than a reduction over so short an axis takes."""
    total = first[:, 0] * second[:, 0]
    for axis in range(1, first.shape[1]):
        total = torch.addcmul(total, first[:, axis], second[:, axis])
    return total


def norm(vectors: Tensor) -> Tensor:
    """|v| (N,) of vectors (N, D); that of nought has no slope, where a root would have an infinite one."""
    square = square_length(vectors)
    return square.clamp_min(torch.finfo(square.dtype).tiny).sqrt()


def square_length(vectors: Tensor) -> Tensor:
    """|v|^2 (N,) of vectors (N, D)."""
    return inner(vectors, vectors)
