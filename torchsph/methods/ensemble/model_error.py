"""Random velocity perturbations that could be flow: smooth, divergence-free, tangential at the walls."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from geometry.grids.fields import convolve_axis

# the potential grows from the wall over this many correlation lengths
_WALL_LAYER = 1.5
# RMS of a plane's divergence over that of its vorticity, in isotropic turbulence that has none in space: <(dw/dz)^2> is
# a fifth of <(du/dy - dv/dx)^2> (Taylor 1935)
_ACROSS = 5**-0.5


def flow_perturbations(
    count: int,
    mask: np.ndarray,
    spacing: tuple[float, ...],
    amplitude: float,
    length: float,
    generator: torch.Generator,
    *,
    cut: bool = False,
) -> Tensor:
    """``count`` fields (count, D, *shape) of mean zero with RMS ``amplitude`` (m/s per component) over the mask.

    Each is the curl of a potential (2-D: the rotated gradient): white noise, smoothed by a Gaussian of standard
    deviation ``length`` (m), times a ramp that vanishes at the edge of the mask, so that the field has no divergence
    and no flow through the wall up to the truncation of central differences.  The ensemble mean is taken out.

    Args:
        mask: (*shape) bool. spacing: (D,), m, x first. generator: on the CPU; the same seed gives the same fields.
        cut: of a plane cut out of a flow in space, whose fields have a divergence too.
    """
    dimension = mask.ndim
    potentials = (2 if cut else 1) if dimension == 2 else 3
    step = list(reversed(spacing))  # array order
    ramp = distance_transform_edt(mask, sampling=step) / (_WALL_LAYER * length)
    ramp = torch.from_numpy(np.clip(ramp, 0.0, 1.0) ** 2)
    noise = torch.randn((count, potentials, *mask.shape), generator=generator, dtype=torch.float64)
    potential = _smoothed(noise, [length / s for s in step]) * ramp
    gradient = [torch.gradient(potential, spacing=s, dim=a - dimension)[0] for a, s in enumerate(step)]
    along = gradient[::-1]  # d/dx, d/dy(, d/dz)
    if dimension == 2:
        field = torch.stack([along[1][:, 0], -along[0][:, 0]], dim=1)
        if cut:
            field = field + _ACROSS * torch.stack([part[:, 1] for part in along], dim=1)
    else:
        a = [[along[i][:, k] for k in range(3)] for i in range(3)]  # a[i][k] = d A_k / d x_i
        field = torch.stack([a[1][2] - a[2][1], a[2][0] - a[0][2], a[0][1] - a[1][0]], dim=1)
    inside = torch.from_numpy(mask)
    field = torch.where(inside, field, torch.zeros_like(field))
    if count > 1:
        field = field - field.mean(0)
    power = field.square().sum() / (count * dimension * max(int(mask.sum()), 1))
    return field * (amplitude / torch.sqrt(power.clamp_min(torch.finfo(field.dtype).tiny)))


def _smoothed(field: Tensor, deviations: list[float]) -> Tensor:
    """Gaussian smoothing along the trailing axes; deviations in nodes, the edges' values going on beyond them."""
    for axis, sigma in enumerate(deviations, -len(deviations)):
        reach = max(1, int(3.0 * sigma + 0.5))
        offset = torch.arange(-reach, reach + 1, dtype=field.dtype)
        weight = torch.exp(-0.5 * (offset / max(sigma, 1e-6)) ** 2)
        place = torch.arange(-reach, field.shape[axis] + reach).clamp(0, field.shape[axis] - 1)
        field = convolve_axis(field.index_select(axis, place), weight / weight.sum(), axis, padded=False)
    return field
