"""Walls a little off where their scene has them, as a variable that torch can differentiate.

A wall that moves outwards by a along its normal makes the distance of a point of the fluid larger by the a of the wall
place nearest to it: to first order that place stays (the envelope theorem; Delfour & Zolesio 2011, ch. 7). What
particles see of the walls follows from the distances as it does for walls that stay.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from geometry.surfaces.surface import Surface

# fields of displaced walls kept with their graphs: of the two key times around the present, with valves open and shut
_KEPT = 4


@dataclass(frozen=True)
class WallDisplacement:
    """How far walls lie outward of where their scene has them.

    Attributes:
        amount: (K,), m, of each shape.
        shapes: (K, V), how far each vertex goes per amount; None: all by ``amount`` (1,).
    """

    amount: Tensor
    shapes: np.ndarray | None = None
    _made: OrderedDict[tuple[int, tuple[int, ...]], Tensor] = field(
        init=False, repr=False, compare=False, default_factory=OrderedDict
    )

    @classmethod
    def checked(cls, amount: float | Tensor, shapes: Tensor | np.ndarray | None, vertices: int) -> WallDisplacement:
        """The displacement of walls with so many vertices.

        Raises:
            ValueError: shapes of another size, amounts that do not go with them, numbers that are not finite.
        """
        given = torch.as_tensor(amount)
        if not given.is_floating_point():
            given = given.double()
        rows = given.reshape(-1)
        if given.ndim > 1 or not bool(torch.isfinite(rows.detach()).all()):
            raise ValueError(
                f"amount of a wall displacement must be a finite number of m, or one for each shape, got {amount}"
            )
        if shapes is None:
            if len(rows) != 1:
                raise ValueError(f"amount holds {len(rows)} numbers, but no shapes are given that they would scale")
            return cls(rows)
        found = np.asarray(shapes.detach().cpu() if isinstance(shapes, Tensor) else shapes, np.float64)
        if found.shape != (len(rows), vertices):
            raise ValueError(
                f"shapes of a wall displacement are {found.shape}: expected a row for each of the {len(rows)} amounts "
                f"and a column for each of the {vertices} vertices of the walls"
            )
        if not np.isfinite(found).all():
            raise ValueError("shapes of a wall displacement must be finite")
        return cls(rows, found)

    def values(self, surface: Surface) -> list[np.ndarray]:
        """The shapes as vertex values (V, D), as many side by side as the surface has dimensions."""
        if self.shapes is None:
            return []
        dimension, columns = surface.vertices.shape[1], self.shapes.T
        short = -columns.shape[1] % dimension
        padded = np.pad(columns, ((0, 0), (0, short)))
        return np.split(np.ascontiguousarray(padded), padded.shape[1] // dimension, axis=1)

    def outward(self, carried: list[np.ndarray], like: Tensor, unit: float) -> Tensor:
        """Displacement of the nearest wall places, in units of ``unit`` m, for a field ``like`` (*shape).

        Args:
            carried: ``values`` at the nearest wall places, (n, D) each.
            like: field of the nodes.
            unit: m.
        """
        amount = self.amount.to(like) / unit
        if self.shapes is None:
            return amount.expand(like.shape)
        rows = np.concatenate(carried, axis=1)[:, : len(self.shapes)]
        return (torch.from_numpy(rows).to(like) @ amount).reshape(like.shape)

    def remembered(self, label: tuple[int, tuple[int, ...]], made: Tensor | None = None) -> Tensor | None:
        """The fields of a key time with some regions open, where they are kept; ``made`` are kept from now on."""
        if made is not None:
            self._made[label] = made
            while len(self._made) > _KEPT:
                self._made.popitem(last=False)
        return self._made.get(label)
