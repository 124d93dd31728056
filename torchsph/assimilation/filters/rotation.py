"""Random orthogonal mixing of members that keeps the ensemble's mean and covariance."""

from __future__ import annotations

import torch
from torch import Tensor

from ..errors import AssimilationError
from .subspace import zero_sum_basis


def random_rotation(
    size: int, generator: torch.Generator, *, batch: tuple[int, ...] = (), device: torch.device | str = "cpu"
) -> Tensor:
    """`(*batch, N, N)` orthogonal matrices with rows and columns summing to one, uniformly distributed.

    Such a matrix mixes anomalies without touching mean or covariance (Sakov & Oke 2008, Mon. Wea. Rev. 136,
    section 3). The orthogonal factor of a Gaussian matrix is uniform (Haar) once the signs of the triangular
    factor's diagonal are fixed (Mezzadri 2007).
    """
    shape = (*batch, size - 1, size - 1)
    draw = torch.randn(shape, generator=generator, dtype=torch.float64, device=generator.device).to(device)
    orthogonal, triangular = torch.linalg.qr(draw)
    orthogonal = orthogonal * torch.sign(torch.diagonal(triangular, dim1=-2, dim2=-1)).unsqueeze(-2)
    basis = zero_sum_basis(size, device=device)
    return basis @ orthogonal @ basis.mT + 1 / size


def need_generator(generator: torch.Generator | None, purpose: str) -> torch.Generator:
    """The generator, or a clear error: nothing here draws from torch's global random state."""
    if generator is None:
        raise AssimilationError(f"{purpose} draws random numbers: pass generator=torch.Generator()")
    return generator
