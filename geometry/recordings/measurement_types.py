"""What a type of measurement sees of a velocity: whole vectors, or its components along directions of the instrument.

Whoever works with a measurement (its error model, its spline, what it would see of a forecast, its residual) asks its
type. A recording's datasets tell which one it is: ``measurement_type``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from geometry.arguments import checked

from .recording import Recording


class MeasurementType(ABC):
    """Components of the velocity along unit vectors at right angles to each other, ``parts`` of them at each node.

    The recording's velocity is the part of the vector that lies in their span. A new type says which recordings are
    its own (``of``), how many components it has and along what; all else follows.

    Attributes:
        name: in words, for messages.
        dataset: of the recording that tells the type, "" for none.
        full: whether the components are the whole vector.
        nyquist: (T,) or (T, parts), m/s, of a measurement that wraps: each component is known modulo twice this.
    """

    name: ClassVar[str]
    dataset: ClassVar[str]
    full: ClassVar[bool] = False
    nyquist: np.ndarray | None = None

    @classmethod
    @abstractmethod
    def of(cls, recording: Recording) -> MeasurementType | None:
        """The type of a recording, or None where it is another one's."""

    @property
    @abstractmethod
    def parts(self) -> int:
        """Components at each node."""

    @abstractmethod
    def directions(self, frame: int) -> np.ndarray:
        """(parts, D, *shape) unit vectors along which a frame was measured."""

    def components(self, velocity: np.ndarray) -> np.ndarray:
        """(T, parts, *shape) what would be measured of a velocity (T, D, *shape), m/s."""
        return np.stack([(field * self.directions(frame)).sum(1) for frame, field in enumerate(velocity)])

    def projected(self, velocity: np.ndarray) -> np.ndarray:
        """(T, D, *shape) the part of a velocity (T, D, *shape), m/s, that lies in the span of the directions."""
        found = self.components(velocity)
        return np.stack([(part[:, None] * self.directions(frame)).sum(0) for frame, part in enumerate(found)])

    def limits(self, frame: int) -> np.ndarray | None:
        """(parts,) speeds, m/s, at which the components of a frame wrap; None where nothing does."""
        return None if self.nyquist is None else np.broadcast_to(self.nyquist[frame], (self.parts,))

    def at(self, frame: int, node: Tensor) -> Components:
        """The components at nodes (q,), flat indices, of one frame."""
        along = np.ascontiguousarray(self.directions(frame), np.float64)
        return Components(torch.from_numpy(along).flatten(2)[:, :, node].mT, self.full, self._limit(frame))

    def _limit(self, frame: int) -> Tensor | None:
        limits = self.limits(frame)
        return None if limits is None else torch.from_numpy(limits.copy())

    def require_full(self, purpose: str) -> None:
        """Refuse what needs whole vectors.

        Args:
            purpose: what needs them, as the beginning of a sentence.

        Raises:
            ValueError: the measurement holds less.
        """
        if not self.full:
            raise ValueError(f"{purpose} full vectors and the measurement holds {self.name}")


@dataclass(frozen=True)
class Components:
    """What is measured at q places of one frame.

    Attributes:
        directions: (parts, q, D) unit vectors, float64.
        full: whether the components are the whole vector, x first.
        limit: (parts,), m/s: each component is known modulo twice this; None where nothing wraps.
    """

    directions: Tensor
    full: bool
    limit: Tensor | None = None

    @property
    def parts(self) -> int:
        """Number of components at a node."""
        return len(self.directions)

    def of(self, vectors: Tensor) -> Tensor:
        """(*batch, parts, q) of vectors (*batch, D, q)."""
        return vectors if self.full else (vectors.unsqueeze(-3) * self.directions.mT).sum(-2)

    def variance(self, variance: Tensor) -> Tensor:
        """(parts, q) error variances of the components from those of the vector's (D, q)."""
        return variance if self.full else variance.mean(0).expand(self.parts, -1)

    def spline_rows(
        self, points: Tensor, samples: Tensor, weight: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """One row for each number that was measured, as a spline takes them.

        Args:
            points: (q, D), m.
            samples: (q, D), m/s.
            weight: (q,).

        Returns:
            Points, samples and weights, and the unit vector (n, D) along which alone each sample counts; None for
            whole vectors.
        """
        if self.full:
            return points, samples, weight, None
        count = self.parts
        return points.repeat(count, 1), samples.repeat(count, 1), weight.repeat(count), self.directions.flatten(0, 1)


class FullVectors(MeasurementType):
    """The whole velocity, as speckle tracking and vector Doppler give it."""

    name = "full vectors"
    dataset = ""
    full = True

    def __init__(self, dimension: int, nyquist: np.ndarray | None = None) -> None:
        self.dimension, self.nyquist = dimension, nyquist

    @classmethod
    def of(cls, recording: Recording) -> FullVectors:
        """Of every recording: it is asked last."""
        return cls(recording.dimension, recording.nyquist)

    @property
    def parts(self) -> int:
        """Number of components at a node: the dimension."""
        return self.dimension

    def directions(self, frame: int) -> np.ndarray:
        """(D, D, 1, ...) unit vectors of the axes, the same everywhere."""
        return np.eye(self.dimension).reshape(self.dimension, self.dimension, *[1] * self.dimension)

    def components(self, velocity: np.ndarray) -> np.ndarray:
        """What is seen of vectors: all of them."""
        return velocity

    def projected(self, velocity: np.ndarray) -> np.ndarray:
        """Vectors as they would be measured: unchanged."""
        return velocity

    def at(self, frame: int, node: Tensor) -> Components:
        """Components of a frame at some nodes: the vectors themselves."""
        axes = torch.eye(self.dimension, dtype=torch.float64)
        return Components(axes[:, None].expand(-1, len(node), -1), True, self._limit(frame))


class AlongBeam(MeasurementType):
    """One component, along the beam: colour Doppler.

    Args:
        beam: (T, D, *shape), or (D, *shape) for all frames, unit vectors.
        dimension: D.
        nyquist: (T,), m/s, at which the speeds wrap, or None.
    """

    name = "one component along a beam"
    dataset = "/beam"

    def __init__(self, beam: np.ndarray, dimension: int, nyquist: np.ndarray | None = None) -> None:
        self.beam, self.moving, self.nyquist = beam, beam.ndim == dimension + 2, nyquist

    @classmethod
    def of(cls, recording: Recording) -> AlongBeam | None:
        """The type of a recording that holds one component along a beam."""
        return None if recording.beam is None else cls(recording.beam, recording.dimension, recording.nyquist)

    @property
    def parts(self) -> int:
        """Number of components at a node: one."""
        return 1

    def directions(self, frame: int) -> np.ndarray:
        """(1, D, *shape) unit vectors along the beam."""
        return (self.beam[frame] if self.moving else self.beam)[None]


class WithinPlanes(MeasurementType):
    """Both components within planes in space, each node in its own: echo planes of several views.

    Args:
        normal: (T, 3, *shape), or (3, *shape) for all frames, unit vectors of the planes; anything where nothing was
            measured.
    """

    name = "two components within planes"
    dataset = "/normal"

    def __init__(self, normal: np.ndarray) -> None:
        self.normal, self.moving = normal, normal.ndim == 5

    @classmethod
    def of(cls, recording: Recording) -> WithinPlanes | None:
        """The type of a recording of planes in space."""
        return None if recording.normal is None else cls(recording.normal)

    @property
    def parts(self) -> int:
        """Number of components at a node: two."""
        return 2

    def directions(self, frame: int) -> np.ndarray:
        """(2, 3, *shape) unit vectors at right angles to the normal and to each other."""
        normal = np.nan_to_num(self.normal[frame] if self.moving else self.normal).astype(np.float64)
        # the axis that the normal follows least is far from it everywhere
        axis = np.moveaxis(np.eye(3)[np.abs(normal).argmin(0)], -1, 0)
        first = np.cross(normal, axis, axis=0)
        first /= np.maximum(np.sqrt((first**2).sum(0)), 1e-12)
        return np.stack([first, np.cross(normal, first, axis=0)])


# in the order in which they are asked for a recording; the last one takes what nobody claims
MEASUREMENT_TYPES: tuple[type[MeasurementType], ...] = (AlongBeam, WithinPlanes, FullVectors)


@checked
def measurement_type(recording: Recording) -> MeasurementType:
    """What the instrument of a recording saw of the velocity."""
    return next(found for kind in MEASUREMENT_TYPES if (found := kind.of(recording)) is not None)
