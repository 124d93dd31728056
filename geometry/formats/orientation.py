"""From the axes of an image to those of a recording: permuted, flipped, turned.

A recording's axes run along x, y, z. An image whose axes lie along them in another order or sense is permuted
and flipped; one that is oblique keeps its own axes, those nearest to x, y, z, and everything else (components
and walls) is turned into them, so that no value is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .source import FormatError

STRAIGHT = 1e-4  # how far a direction may be off an axis and count as that axis (file formats store float32)
SQUARE = 1e-3  # how far axes may be off a right angle


@dataclass(frozen=True, eq=False)
class Orientation:
    """How an image lies.

    Attributes:
        order: (D,), the image axis (0 = i, 1 = j, ...) that lies along the recording's x, y, z.
        sense: (D,), +1 or -1: whether it runs the same way.
        turn: (D, D), rotation from the recording's coordinates to the file's: place = turn @ recorded place.
        origin: (D,), place of the first node, in the recording's coordinates, m.
        spacing: (D,), along x, y, z, m.
    """

    order: tuple[int, ...]
    sense: tuple[int, ...]
    turn: np.ndarray
    origin: np.ndarray
    spacing: np.ndarray

    @classmethod
    def of(cls, affine: np.ndarray, counts: tuple[int, ...], path: str) -> Orientation:
        """From an affine in metres and the number of nodes along i, j, k.

        Raises:
            FormatError: the axes are not at right angles, or have no length.
        """
        matrix, dimension = affine[:-1, :-1], len(counts)
        length = np.linalg.norm(matrix, axis=0)
        if not (np.isfinite(affine).all() and (length > 0).all()):
            raise FormatError(f"{path}: spacing must be positive and finite, not {length.tolist()}")
        direction = matrix / length
        if np.abs(direction.T @ direction - np.eye(dimension)).max() > SQUARE:
            raise FormatError(f"{path}: its axes are not at right angles; resample the image to a rectangular grid")
        order, sense = _nearest(direction)
        turn = np.stack([sense[axis] * direction[:, order[axis]] for axis in range(dimension)], axis=1)
        if np.abs(turn - np.eye(dimension)).max() < STRAIGHT:
            turn = np.eye(dimension)
        spacing = length[list(order)]
        first = turn.T @ affine[:-1, -1]
        back = np.array(
            [(counts[order[axis]] - 1) * spacing[axis] if sense[axis] < 0 else 0.0 for axis in range(dimension)]
        )
        return cls(order, sense, turn, first - back, spacing)

    def field(self, values: np.ndarray) -> np.ndarray:
        """A field indexed `[..., k, j, i]` as one indexed `[..., z, y, x]`."""
        dimension = len(self.order)
        lead = values.ndim - dimension
        axes = [lead + dimension - 1 - self.order[axis] for axis in reversed(range(dimension))]
        turned = np.transpose(values, [*range(lead), *axes])
        flip = [lead + dimension - 1 - axis for axis in range(dimension) if self.sense[axis] < 0]
        return np.flip(turned, tuple(flip)) if flip else turned

    def components(self) -> np.ndarray:
        """(D, D): recorded components from those along the image's own axes i, j, k."""
        matrix = np.zeros((len(self.order),) * 2)
        for axis, (image_axis, sense) in enumerate(zip(self.order, self.sense, strict=True)):
            matrix[axis, image_axis] = sense
        return matrix


def _nearest(direction: np.ndarray) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """For each axis x, y, z the image axis nearest to it, each once, largest agreement first."""
    size = np.abs(direction).copy()
    order = [0] * len(size)
    for _ in range(len(size)):
        axis, image_axis = np.unravel_index(int(size.argmax()), size.shape)
        order[axis] = int(image_axis)
        size[axis, :] = -1
        size[:, image_axis] = -1
    sense = tuple(1 if direction[axis, order[axis]] > 0 else -1 for axis in range(len(order)))
    return tuple(order), sense
