"""Velocity fields that scatterers follow: uniform and sheared motion, and the motion a recording holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from torch import Tensor

from geometry import Grid, Recording

REFINEMENT = 3  # linear pieces per cell of a recording, whose error is then a ninth of the cell's


class Flow(Protocol):
    """Velocity of everything in view, blood and tissue, as a function of place and time."""

    def velocity(self, points: Tensor, time: float) -> Tensor:
        """Velocity (n, D), m/s, at points (n, D), m."""
        ...

    def blood(self, points: Tensor, time: float) -> Tensor:
        """Whether points (n, D) lie in blood, bool (n,); elsewhere is tissue."""
        ...


@dataclass(frozen=True)
class LinearFlow:
    """Blood everywhere that moves by at_centre + gradient (x - centre): uniform motion, shear, rotation; steady.

    Args:
        at_centre: (D,), m/s, the velocity at the centre.
        gradient: (D, D), 1/s, row = component, column = direction; ``None`` = uniform.
        centre: (D,), m; ``None`` = the origin.
    """

    at_centre: tuple[float, ...]
    gradient: tuple[tuple[float, ...], ...] | None = None
    centre: tuple[float, ...] | None = None

    def velocity(self, points: Tensor, time: float) -> Tensor:
        """See :class:`Flow`."""
        value = points.new_tensor(self.at_centre).expand_as(points)
        if self.gradient is None:
            return value
        offset = points if self.centre is None else points - points.new_tensor(self.centre)
        return value + offset @ points.new_tensor(self.gradient).T

    def blood(self, points: Tensor, time: float) -> Tensor:
        """See :class:`Flow`."""
        return torch.ones(len(points), dtype=torch.bool, device=points.device)


class RecordingFlow:
    """The motion that a recording holds: blood inside its mask, tissue that follows the nearest wall outside.

    Beyond an orifice (where the nearest vertex belongs to no wall face) the blood goes on with the
    velocity of the nearest node inside. Cubic between the nodes and linear in time, so velocity is continuous
    across the wall: a field that were linear would have its kinks at the very nodes that are measured, and differ
    there from its own mean over a kernel by twice as much as a smooth one.

    Args:
        recording: the motion.
        margin: m, how far the field reaches beyond the recording's grid; it is constant further out.
        dtype: precision of the field.
        device: where it is kept.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        margin: float = 4e-3,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        self._recording, self._dtype, self._device = recording, dtype, device
        self._pad = max(1, int(np.ceil(margin / min(recording.grid.spacing))))
        self.grid: Grid = recording.grid.padded(self._pad)
        self._nodes = self.grid.nodes(dtype=torch.float64).numpy()
        self._cache: dict[int, tuple[Tensor, Tensor]] = {}

    def velocity(self, points: Tensor, time: float) -> Tensor:
        """See :class:`Flow`."""
        first, share = self._place(time)
        field = self._frame(first)[0]
        if share > 0:
            field = torch.lerp(field, self._frame(first + 1)[0], share)
        return self._sample(field, points).T

    def blood(self, points: Tensor, time: float) -> Tensor:
        """See :class:`Flow`."""
        first, share = self._place(time)
        inside = self._frame(first)[1]
        if share > 0:
            inside = torch.lerp(inside, self._frame(first + 1)[1], share)
        return self._sample(inside, points)[0] > 0.5

    def _place(self, time: float) -> tuple[int, float]:
        """Frame at or before ``time`` and the share of the next; the end frames hold beyond the ends."""
        times = self._recording.time
        if time <= times[0] or len(times) == 1:
            return 0, 0.0
        if time >= times[-1]:
            return len(times) - 1, 0.0
        first = int(np.searchsorted(times, time, side="right")) - 1
        return first, float((time - times[first]) / (times[first + 1] - times[first]))

    def _frame(self, frame: int) -> tuple[Tensor, Tensor]:
        """Velocity (D, *refined) and blood (1, *padded, 0 or 1) of a frame; the last few frames are kept."""
        if frame not in self._cache:
            while len(self._cache) > 3:
                self._cache.pop(next(iter(self._cache)))
            velocity, blood = (torch.as_tensor(f, dtype=self._dtype, device=self._device) for f in self._extend(frame))
            self._cache[frame] = refined(velocity, REFINEMENT), blood[None]
        return self._cache[frame]

    def _extend(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Velocity (D, *padded), m/s, and blood (*padded), bool, at every node of the padded grid."""
        recording, pad = self._recording, self._pad
        mask = np.pad(recording.mask[frame], pad)
        velocity = np.pad(recording.velocity[frame], [(0, 0)] + [(pad, pad)] * mask.ndim)
        surface = recording.wall_for("the simulated scanner").at(frame)
        _, nearest = cKDTree(surface.vertices).query(self._nodes)
        of_wall = np.zeros(len(surface.vertices), bool)
        of_wall[surface.faces[surface.region == 0].reshape(-1)] = True
        tissue = of_wall[nearest].reshape(mask.shape) & ~mask
        moving = wall_velocity(recording, frame)[nearest].T.reshape(velocity.shape)
        steps = recording.grid.spacing[::-1]
        inside = np.indices(mask.shape)
        if mask.any():
            inside = distance_transform_edt(~mask, steps, return_distances=False, return_indices=True)
        velocity = velocity[(slice(None), *inside)]
        return np.where(tissue, moving, velocity), ~tissue

    def _sample(self, field: Tensor, points: Tensor) -> Tensor:
        """Multilinear interpolation of ``field`` (C, *nodes) at points (n, D) -> (C, n), clamped outside."""
        lower, upper = points.new_tensor(self.grid.origin), points.new_tensor(self.grid.upper)
        place = 2 * (points - lower) / (upper - lower) - 1  # the padding leaves at least 3 nodes on every axis
        place = place.view(1, len(points), *[1] * (points.shape[1] - 1), points.shape[1])
        sampled = F.grid_sample(
            field[None].to(points), place, mode="bilinear", padding_mode="border", align_corners=True
        )
        return sampled.reshape(field.shape[0], len(points))


def refined(field: Tensor, factor: int) -> Tensor:
    """A field on a finer grid, by cubic convolution (Keys 1981).

    Exact for quadratics away from the rim, where the last node is repeated; the nodes keep their values.

    Args:
        field: (C, *shape).
        factor: cells of the fine grid per cell of the coarse one, along every axis.
    """
    for axis in range(1, field.dim()):
        count = field.shape[axis]
        place = torch.arange(factor * (count - 1) + 1, device=field.device)
        first, offset = place // factor, (place % factor).to(field) / factor
        total = torch.zeros((), dtype=field.dtype, device=field.device)
        for step in (-1, 0, 1, 2):
            far = (offset - step).abs()
            near = 1 + far**2 * (1.5 * far - 2.5)
            weight = torch.where(far <= 1, near, 2 - 4 * far + far**2 * (2.5 - 0.5 * far))
            taken = field.index_select(axis, (first + step).clamp(0, count - 1))
            total = total + taken * weight.view(-1, *[1] * (field.dim() - 1 - axis))
        field = total
    return field


def wall_velocity(recording: Recording, frame: int) -> np.ndarray:
    """Velocity (nv, D), m/s, of the wall's vertices at a frame: as recorded, or differenced."""
    wall = recording.wall_for("the velocity of the wall")
    if wall.velocity is not None:
        return np.asarray(wall.velocity[frame], np.float64)
    if not wall.moves or recording.frames == 1:
        return np.zeros_like(wall.at(frame).vertices)
    before, after = max(frame - 1, 0), min(frame + 1, recording.frames - 1)
    span = recording.time[after] - recording.time[before]
    return (wall.vertices[after] - wall.vertices[before]) / span
