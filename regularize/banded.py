"""Small algebra on lower band storage (n, width): row j holds entries (j, j), (j + 1, j), ..."""

import numpy as np
import torch
from scipy.linalg.blas import dsbmv


def widen(scalar: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Band of kron(scalar matrix, diag(scale)): component c of every coefficient is scaled by scale (C,)."""
    n, width = scalar.shape
    c = len(scale)
    out = torch.zeros(n, c, width * c, dtype=scalar.dtype)
    for k in range(c):
        out[:, k, ::c] = scale[k] * scalar
    return out.view(n * c, width * c)


def multiply(band: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Symmetric band matrix times x (n, k)."""
    a = band.numpy().T  # Fortran order, as LAPACK wants it
    columns = [dsbmv(len(a) - 1, 1.0, a, column, lower=1) for column in x.T.contiguous().numpy()]
    return torch.from_numpy(np.stack(columns, axis=1))
