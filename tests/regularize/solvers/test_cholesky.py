"""The Cholesky factor of a band, in torch and compiled, against LAPACK's."""

import pytest
import torch
from scipy.linalg import cho_solve_banded, cholesky_banded

from regularize.native import library as native
from regularize.solvers import cholesky
from regularize.solvers.cholesky import STRIP

ALGEBRA = [
    cholesky,
    pytest.param(native, marks=pytest.mark.skipif(not native.available(), reason="not compiled")),
]


def random_band(count, width, seed=0):
    """Positive definite band with a ragged envelope, and the last row of each column in it."""
    generator = torch.Generator().manual_seed(seed)
    own = torch.arange(count)
    extent = torch.randint(0, width, (count,), generator=generator)
    extent[count // 2] = width - 1  # somewhere the band is full
    reach = (own + extent).cummax(0).values.clamp(max=count - 1).minimum(own + width - 1)
    band = torch.randn(count, width, generator=generator, dtype=torch.float64)
    band[torch.arange(width) > (reach - own)[:, None]] = 0.0
    band[:, 0] = 2.0 * width
    return band, reach


@pytest.mark.parametrize(
    "count,width",
    [(1, 1), (5, 1), (7, 7), (40, 3), (STRIP, STRIP), (3 * STRIP + 5, STRIP + 1), (900, 30), (1000, 2 * STRIP + 60)],
)
@pytest.mark.parametrize("dtype,tolerance", [(torch.float64, 1e-12), (torch.float32, 1e-4)])
@pytest.mark.parametrize("algebra", ALGEBRA)
def test_factor_and_solutions_equal_lapack(algebra, count, width, dtype, tolerance):
    band, reach = random_band(count, width)
    expected = cholesky_banded(band.numpy().T, lower=True)
    factor = band.to(dtype)
    assert algebra.factorise(factor, reach)
    inside = torch.arange(width) < count - torch.arange(count)[:, None]  # places past the last row are not the matrix's
    difference = (factor.double() - torch.from_numpy(expected.T))[inside]
    assert float(difference.abs().max()) < tolerance * width
    right = torch.randn(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    half = algebra.solve(factor, reach, right.to(dtype), lower=True, upper=False)
    solved = algebra.solve(factor, reach, half, lower=False, upper=True)
    assert torch.equal(solved, algebra.solve(factor, reach, right.to(dtype), lower=True, upper=True))
    wanted = torch.from_numpy(cho_solve_banded((expected, True), right.numpy()))
    assert torch.allclose(solved.double(), wanted, atol=tolerance)


@pytest.mark.parametrize("algebra", ALGEBRA)
def test_entries_of_unlike_size_keep_their_digits(algebra):
    """Rows and columns scaled over sixteen orders: the factor is scaled alike, to the last digits."""
    band, reach = random_band(300, 40)
    scale = 10.0 ** torch.linspace(-8, 8, 300, dtype=torch.float64)
    row = (torch.arange(300)[:, None] + torch.arange(40)).clamp(max=299)
    scaled = band * scale[:, None] * scale[row]
    assert algebra.factorise(band, reach) and algebra.factorise(scaled, reach)
    assert torch.allclose(scaled / scale[row], band, rtol=0.0, atol=1e-13 * float(band.max()))


@pytest.mark.parametrize("algebra", ALGEBRA)
def test_an_indefinite_matrix_is_told(algebra):
    band, reach = random_band(400, 150)
    band[333, 0] = -1.0
    assert not algebra.factorise(band, reach)
