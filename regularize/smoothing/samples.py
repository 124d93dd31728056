"""Samples, walls and divergence points, checked and brought to float64, ready to become rows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import prod
from typing import Any

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError

from regularize.basis.knots import Knots
from regularize.errors import InvalidInput
from regularize.rows.given import dense
from regularize.rows.walls import WallRows
from regularize.statistics.likelihood import Choice


@dataclass(frozen=True)
class FitData:
    """Samples of positive weight, walls and divergence points inside the box, in float64.

    Points have A columns: D coordinates in m, and the time in s as a last one where the fit runs over it.
    """

    points: torch.Tensor  # (n, A)
    velocity: torch.Tensor  # (n, D) m/s
    weight: torch.Tensor  # (n,) row weights: confidence ** power
    beam: torch.Tensor | None  # (n, D) unit vectors along which alone the velocity is known
    wall: WallRows | None
    divergence_points: torch.Tensor | None  # (m, A)
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    left_out: int  # wall and divergence points beyond a given box
    component_weight: torch.Tensor  # (D,) row factors, root mean square 1: components differ in noise
    dtype: torch.dtype  # of the velocities as given, and of the field

    @classmethod
    def checked(
        cls,
        points: torch.Tensor,
        velocity: torch.Tensor,
        weight: torch.Tensor | None = None,
        wall: WallRows | None = None,
        divergence_points: torch.Tensor | None = None,
        box: tuple[Sequence[float], Sequence[float]] | None = None,
        power: float = 1.0,
        beam: torch.Tensor | None = None,
    ) -> "FitData":
        """Check every array (InvalidInput names the first rule broken) and drop samples of zero weight."""
        dtype = dense("velocity", velocity).dtype
        points, velocity, weight, beam = _checked_samples(points, velocity, weight, beam)
        wall = None if wall is None else wall.to(points.dtype, points.device)
        extra = None if divergence_points is None else dense("divergence_points", divergence_points).to(points)
        others = {"wall points": None if wall is None else wall.points, "divergence_points": extra}
        for name, more in others.items():
            if more is not None and (more.ndim != 2 or more.shape[1] != points.shape[1]):
                raise InvalidInput(f"{name} have shape {tuple(more.shape)}: expected (m, {points.shape[1]})")
            if more is not None and not bool(torch.isfinite(more).all()):
                raise InvalidInput(f"{name} hold NaN or infinity: leave those out")
        if wall is not None and wall.normals.shape[1] != velocity.shape[1]:
            raise InvalidInput(f"wall normals must have {velocity.shape[1]} components like the samples")
        left_out = 0
        if box is None:
            together = torch.cat([points, *(more for more in others.values() if more is not None)])
            lower, upper = together.amin(0), together.amax(0)
        else:
            lower, upper = _checked_box(box, points)
            if wall is not None:
                keep = ((wall.points >= lower) & (wall.points <= upper)).all(1)
                left_out += int((~keep).sum())
                wall = wall.subset(keep) if bool(keep.any()) else None
            if extra is not None:
                keep = ((extra >= lower) & (extra <= upper)).all(1)
                left_out += int((~keep).sum())
                extra = extra[keep]
        corners = tuple(lower.tolist()), tuple(upper.tolist())
        even = torch.ones_like(velocity[0])
        dtype = dtype if dtype.is_floating_point else torch.float64
        return cls(points, velocity, weight**power, beam, wall, extra, *corners, left_out, even, dtype)

    @property
    def components(self) -> int:
        """D, of the velocity."""
        return self.velocity.shape[1]

    @property
    def over_time(self) -> bool:
        """Whether the last column of the points is the time."""
        return self.points.shape[1] > self.components

    def reweighed(self, choice: Choice) -> "FitData":
        """With the robust factors and component noise that an automatic choice found."""
        precision = choice.deviation**-2
        each = (precision / precision.mean()).sqrt().to(self.points)
        # discarded samples stay as rows of weight 0: the field remains defined where they lie
        factor = choice.robust.sqrt().to(self.weight)
        return self._at_the_same_points(weight=self.weight * factor, component_weight=each)

    def _at_the_same_points(self, **changes: Any) -> "FitData":
        """A copy with changes that leave the points where they are."""
        other = replace(self, **changes)
        vars(other)["volume"] = self.volume  # the hull of all points takes as long as assembling the rows
        return other

    def cpu(self) -> "FitData":
        """The same data on the CPU."""
        move: dict[str, Any] = {name: v.cpu() for name, v in vars(self).items() if isinstance(v, torch.Tensor)}
        wall = None if self.wall is None else self.wall.to(torch.float64, "cpu")
        return self._at_the_same_points(wall=wall, **move)

    def extent(self, knots: Knots) -> float:
        """Volume (times duration) over which penalties are averaged; one knot cell's for flat data."""
        volume = self.volume or prod(knots.spacing[: self.components])
        if not self.over_time:
            return volume
        times = self.points[:, -1]
        return volume * (float(times.max() - times.min()) or knots.spacing[-1])

    @cached_property
    def volume(self) -> float:
        """Volume (area in 2-D) that samples and walls span, in m^D; 0 where they lie in one plane."""
        cloud = self.points if self.wall is None else torch.cat([self.points, self.wall.points])
        try:
            return float(ConvexHull(_ends(cloud[:, : self.components].detach().double().cpu().numpy())).volume)
        except (QhullError, ValueError):  # fewer than D + 1 points, or all in one plane
            return 0.0


def _ends(cloud: np.ndarray) -> np.ndarray:
    """The points (n, D) without those between two others on a line along the first axis: they are no corners."""
    order = np.lexsort(cloud.T)
    line = np.any(np.diff(cloud[order, 1:], axis=0) != 0, axis=1)
    return cloud[order[np.append(True, line) | np.append(line, True)]]


def _checked_samples(
    points: torch.Tensor,
    velocity: torch.Tensor,
    weight: torch.Tensor | None,
    beam: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor | None]:
    # strong penalties amplify rounding by the condition number: rows are always built in float64
    velocity = dense("velocity", velocity).double()
    points = dense("points", points).to(velocity)
    shapes = f"points have shape {tuple(points.shape)} and velocity {tuple(velocity.shape)}"
    if velocity.ndim != 2 or velocity.shape[1] not in (2, 3) or points.ndim != 2:
        raise InvalidInput(f"{shapes}: velocity must be (n, D) with D = 2 or 3")
    if len(points) != len(velocity) or points.shape[1] - velocity.shape[1] not in (0, 1):
        raise InvalidInput(f"{shapes}: points must be (n, D), or (n, D + 1) with the time last")
    weight = torch.ones_like(points[:, 0]) if weight is None else dense("weight", weight).to(velocity)
    if weight.shape != points.shape[:1]:
        raise InvalidInput(f"weight has shape {tuple(weight.shape)}: expected ({len(points)},)")
    if not bool(((weight >= 0) & torch.isfinite(weight)).all()):
        raise InvalidInput("weight has negative or non-finite entries: weights must be finite and >= 0")
    keep = weight > 0
    if not bool(keep.any()):
        raise InvalidInput("no sample has a positive weight: there is nothing to fit")
    points, velocity, weight = points[keep], velocity[keep], weight[keep]
    if not bool(torch.isfinite(points).all() and torch.isfinite(velocity).all()):
        raise InvalidInput("points or velocity hold NaN or infinity at a positive weight: set its weight to 0")
    return points, velocity, weight, None if beam is None else _checked_beam(beam, keep, velocity)


def _checked_beam(beam: torch.Tensor, keep: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
    beam = dense("beam", beam).to(velocity)
    if beam.shape == velocity.shape[1:]:
        beam = beam.expand(len(keep), -1)
    if beam.shape != (len(keep), velocity.shape[1]):
        raise InvalidInput(f"beam has shape {tuple(beam.shape)}: expected {(len(keep), velocity.shape[1])}")
    beam = beam[keep]
    if not bool(((beam.norm(dim=1) - 1.0).abs() < 1e-3).all()):
        raise InvalidInput("beam holds vectors that are not of length 1: normalise them")
    return beam


def _checked_box(
    box: tuple[Sequence[float], Sequence[float]], points: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    lower, upper = (torch.as_tensor(side, dtype=points.dtype, device=points.device) for side in box)
    if lower.shape != points.shape[1:] or upper.shape != lower.shape or not bool((upper > lower).all()):
        raise InvalidInput(
            f"box is {box}: expected (lower, upper) corners with {points.shape[1]} numbers each and upper > lower"
        )
    slack = 1e-6 * (upper - lower)
    outside = int((~((points >= lower - slack) & (points <= upper + slack)).all(1)).sum())
    if outside:
        raise InvalidInput(
            f"{outside} samples of positive weight lie outside the box: enlarge it or give them weight 0"
        )
    return lower, upper
