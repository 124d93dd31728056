"""Sums over windows of nodes against SciPy."""

import numpy as np
import pytest
import torch
from scipy.ndimage import uniform_filter1d

from torchsph.ultrasound.estimation.box_sums import box_sum


@pytest.mark.parametrize("nodes", [1, 3, 7, 13, 25])
def test_box_sums_equal_scipy_averages(nodes):
    field = torch.randn((6, 15, 4), generator=torch.Generator().manual_seed(5), dtype=torch.complex128)
    expected = uniform_filter1d(field.numpy(), nodes, axis=1, mode="constant") * nodes
    np.testing.assert_allclose(box_sum(field, nodes, 1).numpy(), expected, atol=1e-12)
