"""Which particles hang together through their kernels: halves of a cavity, drops, strays."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor


def components(
    position: Tensor, member: Tensor, coupled: Tensor, radius: float, period: Tensor | None
) -> tuple[Tensor, int]:
    """Sets of particles that no chain of neighbours joins.

    Args:
        position: (N, D), finite.
        member: (N,) int64; members never hang together.
        coupled: (N,) bool, particles that join; each of the others is labelled as the first set of its member.
        radius: of the kernel, in the unit of ``position``.
        period: (D,), inf where an axis is not periodic, or None.

    Returns:
        Labels (N,) int64 of the sets, from 0 on, and their number.
    """
    place = position.detach().double().cpu().numpy()
    label = np.zeros(len(place), np.int64)
    box, count = None, 0
    if period is not None:
        length = period.double().cpu().numpy()
        place = np.where(np.isfinite(length), np.mod(place, np.where(np.isfinite(length), length, 1.0)), place)
        box = np.where(np.isfinite(length), length, 0.0)  # 0: not periodic
    owner, joins = member.cpu().numpy(), coupled.cpu().numpy()
    for index in range(int(owner.max()) + 1 if len(owner) else 0):
        mine = np.flatnonzero((owner == index) & joins)
        pairs = cKDTree(place[mine], boxsize=box).query_pairs(radius, output_type="ndarray")
        graph = coo_matrix((np.ones(len(pairs), bool), pairs.T), shape=(len(mine), len(mine)))
        found, parts = connected_components(graph, directed=False)
        label[owner == index] = count
        label[mine] = count + parts
        count += max(found, 1)
    return torch.from_numpy(label).to(member.device), count
