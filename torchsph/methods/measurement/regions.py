"""Parts of a ventricle that errors are told apart by: the jet, the layer at the wall, the apex."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

import geometry

# the jet: faster than this share of the fastest; the wall layer in grid spacings; the apex: the last share of the way
_FAST, _LAYER, _LAST = 0.5, 2.0, 2.0 / 3.0


def flow_regions(surface: geometry.Surface, position: Tensor, speed: Tensor, spacing: float) -> dict[str, Tensor]:
    """Masks (q,) over places by name: "jet", "near wall" and, where the surface has orifices, "apex".

    Args:
        surface: at this time. position: (q, D), m. speed: (q,), m/s, of the estimate there (NaN counts as slow).
        spacing: of the measurement's grid, m. The apex is the third of the long axis that is farthest from the mean of
            the orifices.
    """
    speed = torch.nan_to_num(speed)
    fastest = float(speed.max()) if len(speed) else 0.0
    walls = surface.region == 0
    distance, _ = cKDTree(surface.centroids[walls]).query(position.numpy())
    found = {
        "jet": speed > _FAST * fastest if fastest > 0 else torch.zeros(len(speed), dtype=torch.bool),
        "near wall": torch.from_numpy(np.asarray(distance) < _LAYER * spacing),
    }
    if not walls.all():
        orifice = surface.centroids[~walls].mean(0)
        axis = surface.vertices.mean(0) - orifice
        axis = axis / max(float(np.linalg.norm(axis)), 1e-300)
        depth = float(((surface.vertices - orifice) @ axis).max())
        along = (position.numpy() - orifice) @ axis
        found["apex"] = torch.from_numpy(along > _LAST * depth)
    return found
