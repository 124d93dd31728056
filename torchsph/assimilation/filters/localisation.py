"""Localisation: distances, the taper, and a coarse grid on which local analyses are made.

Members are few, so their sampled covariances between distant places are noise; a taper removes them
(Houtekamer & Mitchell 2001; Hamill et al. 2001). Throughout, `radius` is the distance at which the taper
reaches ZERO: twice the length c of Gaspari & Cohn, 3.65 times the standard deviation of the Gaussian it
resembles.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import AssimilationError

# of which a taper takes about ten copies on its way: they stay in the cache, and small beside what they are summed to
_TAPERS_AT_ONCE = 250_000


def gaspari_cohn(distance: Tensor) -> Tensor:
    """The compactly supported correlation of Gaspari & Cohn (1999), QJRMS 125, eq. 4.10.

    `distance` is relative to the radius at which the result becomes zero; any shape. Symmetric, 1 at zero,
    twice continuously differentiable, a valid correlation function in up to three dimensions.
    """
    z = 2 * distance.abs()
    near = ((((-0.25 * z + 0.5) * z + 0.625) * z - 5 / 3) * z * z) + 1
    outer = z.clamp(min=1.0)
    far = (((((outer / 12 - 0.5) * outer + 0.625) * outer + 5 / 3) * outer - 5) * outer) + 4 - 2 / (3 * outer)
    return torch.where(z <= 1, near, torch.where(z < 2, far.clamp(min=0.0), 0.0))


@dataclass(frozen=True)
class Localisation:
    """Where observations act.

    Attributes:
        radius: distance, one or per dimension, in the unit of the positions, at and beyond which an
            observation has no influence. Zero switches all observations off.
        period: extent of a periodic domain per dimension (infinity: not periodic), or None.
    """

    radius: float | tuple[float, ...]
    period: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        radii = self.radius if isinstance(self.radius, tuple) else (self.radius,)
        if not all(value >= 0 for value in radii):
            raise AssimilationError(f"localisation radius must be >= 0, got {self.radius}")
        if self.period is not None and not all(value > 0 for value in self.period):
            raise AssimilationError(f"periods must be positive (infinity: not periodic), got {self.period}")

    @property
    def off(self) -> bool:
        """Whether nothing is local."""
        return self.radius == 0 or (isinstance(self.radius, tuple) and min(self.radius) == 0)

    def scaled(self, positions: Tensor) -> Tensor:
        """`(k, D)` positions in units of the radius, float64."""
        radius = torch.as_tensor(self.radius, dtype=torch.float64, device=positions.device)
        return positions.double() / radius

    def scaled_period(self, dimension: int, device: torch.device) -> Tensor:
        """`(D,)` in units of the radius, infinity where not periodic."""
        if self.period is None:
            return torch.full((dimension,), math.inf, dtype=torch.float64, device=device)
        if len(self.period) != dimension:
            raise AssimilationError(f"period {self.period} does not fit positions of {dimension} dimensions")
        radius = torch.as_tensor(self.radius, dtype=torch.float64, device=device)
        return torch.tensor(self.period, dtype=torch.float64, device=device) / radius

    def taper(self, first: Tensor, second: Tensor) -> Tensor:
        """`(a, b)` weights between SCALED positions `(a, D)` and `(b, D)`."""
        rows = max(1, _TAPERS_AT_ONCE // max(1, len(second)))
        return torch.cat([self._taper(part, second) for part in first.split(rows)])

    def _taper(self, first: Tensor, second: Tensor) -> Tensor:
        if self.period is None:
            return gaspari_cohn(torch.cdist(first, second, compute_mode="donot_use_mm_for_euclid_dist"))
        period = self.scaled_period(first.shape[-1], first.device)
        step = first.unsqueeze(1) - second.unsqueeze(0)
        turns = torch.where(torch.isfinite(period), torch.round(step / period), 0.0)
        step = step - torch.where(turns != 0, turns * period, 0.0)
        return gaspari_cohn(step.norm(dim=-1))


@dataclass(frozen=True)
class PatchGrid:
    """A grid of local analyses; a point belongs to the 2^D nodes around it with multilinear weights.

    `origin`, `spacing` `(D,)`; `shape`; `periodic` per dimension. Lengths in units of the radius.
    """

    origin: Tensor
    spacing: Tensor
    shape: tuple[int, ...]
    periodic: tuple[bool, ...]

    @classmethod
    def around(cls, points: Tensor, spacing: float, period: Tensor) -> PatchGrid:
        """The grid of at most `spacing` that covers `points (k, D)`; a period is divided evenly."""
        low, high = points.min(0).values, points.max(0).values
        wraps = torch.isfinite(period)
        extent = torch.where(wraps, period, high - low)
        cells = torch.ceil(extent / spacing - 1e-9).clamp(min=1)
        step = torch.where(extent > 0, extent / cells, torch.full_like(extent, spacing))
        nodes = torch.where(wraps, cells, cells + 1)
        return cls(low, step, tuple(int(k) for k in nodes), tuple(bool(w) for w in wraps))

    def nodes(self, flat: Tensor) -> Tensor:
        """`(k, D)` positions of the nodes with flat indices `flat (k,)`."""
        index = torch.stack(torch.unravel_index(flat, self.shape), -1)
        return self.origin + index * self.spacing

    def share(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """`(k, 2^D)` flat node indices and multilinear weights (summing to one) of `points (k, D)`."""
        place = (points - self.origin) / self.spacing
        count = torch.tensor(self.shape, dtype=torch.float64, device=points.device)
        wraps = torch.tensor(self.periodic, device=points.device)
        place = torch.where(wraps, place - torch.floor(place / count) * count, place)
        last = torch.tensor(
            [n - 1 if wraps else max(n - 2, 0) for n, wraps in zip(self.shape, self.periodic, strict=True)],
            device=points.device,
        )
        cell = torch.minimum(torch.floor(place).long().clamp(min=0), last)
        fraction = (place - cell).clamp(0, 1)
        period = torch.tensor(self.shape, device=points.device)
        indices, weights = [], []
        for corner in itertools.product((0, 1), repeat=len(self.shape)):
            offset = torch.tensor(corner, device=points.device)
            node = (cell + offset) % period
            flat = torch.zeros(len(points), dtype=torch.long, device=points.device)
            for axis, nodes in enumerate(self.shape):
                flat = flat * nodes + node[:, axis]
            indices.append(flat)
            weights.append(torch.where(offset.bool(), fraction, 1 - fraction).prod(-1))
        return torch.stack(indices, -1), torch.stack(weights, -1)


@dataclass(frozen=True)
class Groups:
    """Items gathered by patch and padded to equal length, for batched products.

    `patch (P,)` sorted ids; `item (P, K)` indices; `weight (P, K)`, zero for padding.
    """

    patch: Tensor
    item: Tensor
    weight: Tensor

    @classmethod
    def of(cls, patch: Tensor, item: Tensor, weight: Tensor) -> Groups:
        """From pairs `(n,)`; pairs of zero weight are dropped."""
        keep = weight > 0
        patch, item, weight = patch[keep], item[keep], weight[keep]
        order = torch.argsort(patch, stable=True)
        ids, counts = torch.unique_consecutive(patch[order], return_counts=True)
        width = int(counts.max()) if len(ids) else 0
        row = torch.repeat_interleave(torch.arange(len(ids), device=patch.device), counts)
        start = torch.cumsum(counts, 0) - counts
        column = torch.arange(len(row), device=patch.device) - start[row]
        items = torch.zeros(len(ids), width, dtype=torch.long, device=patch.device)
        weights = torch.zeros(len(ids), width, dtype=torch.float64, device=patch.device)
        items[row, column] = item[order]
        weights[row, column] = weight[order]
        return cls(ids, items, weights)

    def chunks(self, numbers_per_item: int, limit: int = 8_000_000) -> list[slice]:
        """Slices of patches whose gathered items hold at most about `limit` numbers each."""
        size = max(1, limit // max(1, self.item.shape[1] * numbers_per_item))
        return [slice(k, min(k + size, len(self.patch))) for k in range(0, len(self.patch), size)]
