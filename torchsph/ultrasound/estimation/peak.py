"""Where between the nodes a correlation peaks: a paraboloid through the 3^D values around the highest one.

The paraboloid is fitted to the logarithm, so that a Gaussian peak is exact; fitted to the correlation
itself it is drawn to the nodes by some hundredths of their spacing.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

FIT_WEIGHTS = (1.0, 1.0, 0.1, 0.01)  # of nodes 0 to 3 steps off the middle


@dataclass(frozen=True, eq=False)
class Peak:
    """A correlation peak of each point; lags in nodes, in the order of the array's axes.

    Args:
        lag: (P, A), nodes, of the vertex, from the middle of the search.
        hessian: (P, A, A), per node squared, of log |rho|.
        value: (P,), complex rho at the vertex, |value| <= 1.
        ratio: (P,), of the highest magnitude to the highest other local maximum, or to the lowest value where
            there is none.
        concave: (P,), bool, whether the paraboloid has a maximum.
    """

    lag: Tensor
    hessian: Tensor
    value: Tensor
    ratio: Tensor
    concave: Tensor

    def constrained(self, direction: Tensor, along: Tensor) -> Tensor:
        """Lag (P, A) of the paraboloid's maximum among those with lag . direction = along.

        With an axial lag known better (from the phase), the lateral ones follow it along the paraboloid's
        ridge.

        Args:
            direction: (P, A).
            along: (P,).
        """
        tilt = torch.linalg.solve(self.hessian, direction[..., None])[..., 0]
        gap = along - (self.lag * direction).sum(-1)
        return self.lag + tilt * (gap / (tilt * direction).sum(-1))[:, None]


def find_peak(rho: Tensor) -> Peak:
    """The peak of |rho|.

    At the rim of the search the paraboloid is fitted one node further in and may be followed outwards by
    up to a node and a half: a peak beyond the rim shows as a lag beyond it.

    Args:
        rho: (P, L1, ..., LA), complex, with three or more (odd) lags on every axis.
    """
    lags = rho.shape[1:]
    magnitude = rho.abs()
    flat = magnitude.flatten(1)
    best = flat.argmax(1)
    centre = _unravel(best, lags)
    inner = torch.stack([c.clamp(1, n - 2) for c, n in zip(centre, lags, strict=True)], 1)
    neighbours = _neighbourhood(rho, inner)
    fit = _fit_matrix(len(lags)).to(neighbours.device)
    terms = neighbours.abs().clamp_min(1e-6).log() @ fit.to(flat).T
    gradient, hessian = _derivatives(terms, len(lags))
    concave = (torch.linalg.eigvalsh(hessian) < -1e-6).all(-1)
    safe = torch.where(concave[:, None, None], hessian, -torch.eye(len(lags)).to(hessian))
    vertex = -torch.linalg.solve(safe, gradient[..., None])[..., 0]
    concave &= (vertex.abs() <= 1.5).all(-1)
    vertex = vertex.clamp(-1.5, 1.5)
    value = (_terms(vertex) * (neighbours @ fit.to(neighbours).T)).sum(-1)
    value = value / value.abs().clamp_min(1.0)
    middle = torch.tensor([n // 2 for n in lags], device=rho.device)
    return Peak(inner - middle + vertex, safe, value, _peak_ratio(magnitude, best), concave)


def _terms(offset: Tensor) -> Tensor:
    """Monomials (P, K) of a quadratic at ``offset`` (P, A): 1, linear, then products with a <= b."""
    axes = offset.shape[-1]
    quadratic = [offset[:, a] * offset[:, b] for a in range(axes) for b in range(a, axes)]
    return torch.stack([torch.ones_like(offset[:, 0]), *offset.unbind(-1), *quadratic], -1)


def _fit_matrix(axes: int) -> Tensor:
    """(K, 3^A): weighted least-squares coefficients of the quadratic from values on {-1, 0, 1}^A.

    The further from the middle, the less a correlation is a quadratic: nodes off by one step on two or
    three axes weigh 1/10 and 1/100. They are needed for the mixed derivatives alone; with equal weights
    their misfit made up most of the lateral error on noise-free uniform motion.
    """
    nodes = torch.tensor(list(product((-1.0, 0.0, 1.0), repeat=axes)), dtype=torch.float64)
    steps = (nodes != 0).sum(1)
    weight = nodes.new_tensor(FIT_WEIGHTS)[steps].sqrt()
    return torch.from_numpy(np.linalg.pinv((_terms(nodes) * weight[:, None]).numpy())) * weight


def _derivatives(terms: Tensor, axes: int) -> tuple[Tensor, Tensor]:
    """Gradient (P, A) and Hessian (P, A, A) at the central node of quadratics (P, K)."""
    hessian = terms.new_empty(len(terms), axes, axes)
    column = 1 + axes
    for a in range(axes):
        for b in range(a, axes):
            hessian[:, a, b] = hessian[:, b, a] = terms[:, column] * (2.0 if a == b else 1.0)
            column += 1
    return terms[:, 1 : 1 + axes], hessian


def _unravel(flat: Tensor, shape: tuple[int, ...]) -> list[Tensor]:
    parts = []
    for size in reversed(shape):
        parts.append(flat % size)
        flat = flat // size
    return parts[::-1]


def _neighbourhood(rho: Tensor, centre: Tensor) -> Tensor:
    """Values (P, 3^A) around ``centre`` (P, A), in the order of :func:`_fit_matrix`."""
    axes = centre.shape[1]
    steps = torch.tensor(list(product((-1, 0, 1), repeat=axes)), device=rho.device)
    index = centre[:, None, :] + steps
    flat = torch.zeros_like(index[..., 0])
    for axis in range(axes):
        flat = flat * rho.shape[1 + axis] + index[..., axis]
    return rho.flatten(1).gather(1, flat)


def _peak_ratio(magnitude: Tensor, best: Tensor) -> Tensor:
    lags = magnitude.shape[1:]
    pool = F.max_pool3d if len(lags) == 3 else F.max_pool2d
    highest = pool(magnitude[:, None], 3, stride=1, padding=1)[:, 0]
    flat = magnitude.flatten(1)
    summit = (magnitude >= highest).flatten(1).scatter(1, best[:, None], False)
    second = torch.where(summit, flat, 0).amax(1)
    second = torch.where(summit.any(1), second, flat.amin(1))
    return flat.gather(1, best[:, None])[:, 0] / second.clamp_min(1e-6)
