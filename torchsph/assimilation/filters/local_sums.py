"""Tapered sums over observations, for all places at once: the bulk of a local filter's arithmetic.

A local analysis at x needs `sum_o g(|x - x_o|) / R_o y_o y_o'`, an r x r matrix from every observation within
reach. Written as one product of the matrix of tapers with a matrix whose rows are the outer products, it runs
at the speed of matrix multiplication, without gathering neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..observations import Screened
from .localisation import Localisation

_TAPERS_AT_ONCE = 4_000_000


@dataclass(frozen=True)
class LocalSums:
    """Sums per distinct place of observation, ready to be tapered.

    `seen (q, D)` scaled distinct places; `products (*batch, q, r (r + 1) / 2 + r + 1)` upper triangle of
    `y y' / R`, then `y d / R`, then `1 / R`; `rank` r; `useful (m,)` is filled in as places ask: whether an
    observation was within reach of any.
    """

    seen: Tensor
    which: Tensor
    products: Tensor
    rank: int
    localisation: Localisation
    _reached: Tensor = field(repr=False)

    @classmethod
    def of(
        cls,
        modes: Tensor,
        screened: Screened,
        places: Tensor,
        localisation: Localisation,
        dtype: torch.dtype,
    ) -> LocalSums:
        """From observed modes `(*batch, m, r)` at scaled `places (m, D)`.

        For float32 states the sums are made in float32, unless the observations are so precise that its
        rounding would show beside the prior's precision.
        """
        seen, which = torch.unique(places, dim=0, return_inverse=True)
        rank = modes.shape[-1]
        weighted = modes * screened.weight.unsqueeze(-1)
        largest = (weighted * modes).sum((-2, -1)).max().item()
        if largest * torch.finfo(dtype).eps > 1e-3 * rank:
            dtype = torch.float64
        width = rank * (rank + 1) // 2 + rank + 1
        products = torch.zeros(*modes.shape[:-2], len(seen), width, dtype=dtype, device=modes.device)
        column = 0
        for first in range(rank):
            row = weighted[..., first : first + 1] * modes[..., first:]
            _add(products, column, which, row)
            column += rank - first
        _add(products, column, which, weighted * screened.innovation.unsqueeze(-1))
        _add(products, column + rank, which, screened.weight.unsqueeze(-1))
        reached = torch.zeros(len(seen), dtype=torch.bool, device=modes.device)
        return cls(seen.to(dtype), which, products, rank, localisation, reached)

    @property
    def useful(self) -> Tensor:
        """`(m,)` whether each observation was within reach of any place asked so far."""
        return self._reached[self.which]

    def parts(self, places: Tensor) -> list[slice]:
        """Slices of `places (P, D)` that bound the memory of `at`."""
        per_place = len(self.seen) * places.shape[1] + math.prod(self.products.shape[:-2]) * self.rank**2
        step = max(1, _TAPERS_AT_ONCE // max(1, per_place))
        return [slice(k, min(k + step, len(places))) for k in range(0, len(places), step)]

    def at(self, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gram `(*batch, P, r, r)`, right side `(*batch, P, r)`, weight `(*batch, P)`; float64."""
        taper = self.localisation.taper(places.to(self.seen.dtype), self.seen)
        near = (taper > 0).any(0)
        self._reached.logical_or_(near)
        taper, products = taper.to(self.products.dtype), self.products
        if near.double().mean() < 0.8:  # skip what is out of reach of this whole part
            taper, products = taper[:, near], products[..., near, :]
        sums = (taper @ products).double()
        triangle = self.rank * (self.rank + 1) // 2
        upper = torch.triu_indices(self.rank, self.rank, device=places.device)
        gram = sums.new_zeros(*sums.shape[:-1], self.rank, self.rank)
        gram[..., upper[0], upper[1]] = sums[..., :triangle]
        gram[..., upper[1], upper[0]] = sums[..., :triangle]
        return gram, sums[..., triangle:-1], sums[..., -1]


def _add(products: Tensor, column: int, which: Tensor, rows: Tensor) -> None:
    target = products[..., column : column + rows.shape[-1]]
    target.index_add_(-2, which, rows.to(products.dtype))
