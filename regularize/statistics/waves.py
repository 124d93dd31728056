"""Sums of plane waves at samples: by the products of their factors along the axes where samples lie on a grid."""

import torch

SAME = 1e-6  # of the samples' extent along an axis: coordinates so near are one
WORTH = 8  # places of the grid around the samples, to a sample, up to which its axes are worth their product
CHUNK = 1024  # samples whose waves are held at once


class Lattice:
    """Points (n, A) of which many share their coordinates, as those of a grid do; any others take longer."""

    def __init__(self, points: torch.Tensor) -> None:
        self.points = points.float()
        lower, extent = points.amin(0), (points.amax(0) - points.amin(0)).clamp(min=1e-300)
        rounded = ((points - lower) / extent / SAME).round().long()
        self.axes, places = [], []
        for axis in range(points.shape[1]):
            unique, place = torch.unique(rounded[:, axis], return_inverse=True)
            self.axes.append((lower[axis] + unique * SAME * extent[axis]).float())
            places.append(place)
        # lines along the first axis, each with its place on the others
        line = torch.zeros_like(places[0])
        for axis in range(1, len(self.axes)):
            line = line * len(self.axes[axis]) + places[axis]
        self.lines, number = torch.unique(line, return_inverse=True)
        self.place = places[0] * len(self.lines) + number
        self.gridded = len(self.axes[0]) * len(self.lines) <= WORTH * len(points)

    def sum_of_waves(self, waves: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
        """(n, draws) sums of cos(phase + wave . x) over the first axis of the phases.

        Args:
            waves: (A, waves, draws) wave numbers, 1/m, float32.
            phase: (waves, draws), float32.
        """
        return self._by_axes(waves, phase) if self.gridded else self._one_by_one(waves, phase)

    def _by_axes(self, waves: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
        """cos(a + b) = cos a cos b - sin a sin b, a along the first axis and b on the lines: two matrix products."""
        angle, lines = phase[None], self.lines
        for axis in reversed(range(1, len(self.axes))):
            along = self.axes[axis][lines % len(self.axes[axis])]
            angle = angle + along[:, None, None] * waves[axis]
            lines = lines // len(self.axes[axis])
        first = self.axes[0][:, None, None] * waves[0]
        left = torch.cat([first.cos(), first.sin()], dim=1).permute(2, 0, 1)  # (draws, places, waves)
        right = torch.cat([angle.cos(), -angle.sin()], dim=1).permute(2, 1, 0)
        return torch.bmm(left, right).flatten(1)[:, self.place].T

    def _one_by_one(self, waves: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
        parts = []
        for points in self.points.split(CHUNK):
            phases = torch.addmm(phase.flatten(), points, waves.flatten(1))
            parts.append(phases.cos_().view(-1, *phase.shape).sum(1))
        return torch.cat(parts)
