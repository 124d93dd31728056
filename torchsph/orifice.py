"""The plane opening of a valve: where it is, how large, and how points lie relative to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from geometry import Surface


@dataclass(frozen=True)
class Orifice:
    """The faces of one region of a surface, seen as a plane opening (2-D: a straight gap).

    Attributes:
        centre: (D,), m. normal: (D,), unit, outward (out of the blood). area: m^2 (2-D: m) of the projection.
        rim: (E, 2, D) edges (2-D: the two end points as (2, 1, D)) that bound the opening, m.
    """

    centre: np.ndarray
    normal: np.ndarray
    area: float
    rim: np.ndarray

    @classmethod
    def of(cls, surface: Surface, region: int) -> Orifice:
        """The opening made by the faces of ``region``; ValueError where there are none or they have no area."""
        part = surface.part(region)
        if len(part) == 0:
            raise ValueError(f"the wall has no faces with region {region}, so there is no such valve")
        vector = surface.area_vectors[part].sum(0)
        area = float(np.linalg.norm(vector))
        if not area > 0:
            raise ValueError(f"the faces of region {region} enclose no opening: their area vectors cancel")
        weight = surface.areas[part]
        centre = (surface.centroids[part] * weight[:, None]).sum(0) / weight.sum()
        return cls(centre, vector / area, area, surface.vertices[_boundary(surface.faces[part])])

    def height(self, points: np.ndarray) -> np.ndarray:
        """Distance of points (n, D) outward of the plane, m."""
        return (points - self.centre) @ self.normal

    def inset(self, points: np.ndarray) -> np.ndarray:
        """In-plane distance of points (n, D) from the rim, m: positive over the opening, negative beside it."""
        frame = plane_frame(self.normal)
        flat = torch.from_numpy((points - self.centre) @ frame)
        rim = torch.from_numpy((self.rim - self.centre) @ frame)
        return polygon_inset(flat, rim).numpy()


def plane_frame(normal: np.ndarray) -> np.ndarray:
    """(D, D - 1) orthonormal vectors that span the plane across ``normal``."""
    return np.linalg.svd(np.asarray(normal)[None])[2][1:].T.copy()


def polygon_inset(points: Tensor, edges: Tensor) -> Tensor:
    """Distance of points (n, 2) from closed polygons of ``edges`` (E, 2, 2), positive inside.

    On a line, points (n, 1) and ends (2, 1, 1): positive between the two ends.
    """
    if points.shape[1] == 1:
        low, high = edges.min(), edges.max()
        return torch.minimum(points[:, 0] - low, high - points[:, 0])
    start, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    offset = points[:, None, :] - start[None]
    square = (along * along).sum(1).clamp_min(torch.finfo(points.dtype).tiny)
    share = ((offset * along).sum(2) / square).clamp(0.0, 1.0)
    distance = (offset - share[..., None] * along).norm(dim=2).amin(1)
    # even-odd rule: edges crossed by the ray towards +x
    above_start = start[None, :, 1] > points[:, None, 1]
    above_end = edges[None, :, 1, 1] > points[:, None, 1]
    slope = along[:, 0] / torch.where(along[:, 1] == 0, torch.ones_like(square), along[:, 1])
    crossing = start[None, :, 0] + (points[:, None, 1] - start[None, :, 1]) * slope
    inside = ((above_start != above_end) & (points[:, None, 0] < crossing)).sum(1) % 2 == 1
    return torch.where(inside, distance, -distance)


def _boundary(faces: np.ndarray) -> np.ndarray:
    """Edges (E, 2) of triangles that belong to one triangle only; in a plane the ends (2, 1) of the segments."""
    if faces.shape[1] == 2:
        vertex, uses = np.unique(faces, return_counts=True)
        return vertex[uses == 1][:, None]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, first, uses = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return edges[first[uses == 1]]
