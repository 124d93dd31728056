"""Smoothing over time: blurred coefficients of single frames, and fits over time in overlapping windows."""

import math
from collections.abc import Sequence

import torch

from regularize.arguments import NOT_NEGATIVE, checked
from regularize.errors import InvalidInput
from regularize.rows.given import dense
from regularize.rows.walls import WallRows

from .field import SplineField
from .smoother import Smoother

MOST_WINDOWS = 100_000


@checked(width=NOT_NEGATIVE)
def blur_in_time(fields: Sequence[SplineField], times: Sequence[float], width: float) -> list[SplineField]:
    """Gaussian blur, of standard deviation ``width`` in s, of the coefficients of frames at ``times`` in s.

    The temporal blur of Grønli 2017, sec. 3.2.5. The fields share one knot grid. A coefficient that a frame
    does not determine (no row touches it there) takes no part; width 0 changes nothing.
    """
    if len(fields) != len(times) or not fields:
        raise InvalidInput(f"{len(fields)} fields and {len(times)} times: give one time per field")
    if width < 0:
        raise InvalidInput(f"width is {width}: it must be >= 0")
    knots = fields[0].knots
    if any(field.knots != knots for field in fields):
        raise InvalidInput("fields lie on different knot grids: fit all frames with the same box")
    if width == 0:
        return list(fields)
    coefficients = torch.stack([field.coefficients.double().flatten(1) for field in fields])
    known = torch.zeros(len(fields), knots.nodes, dtype=torch.float64)
    for frame, field in enumerate(fields):
        cells = knots.cell_index(field.covered.nonzero().flatten())
        known[frame, knots.local_nodes(cells).flatten()] = 1.0
    t = torch.as_tensor(times, dtype=torch.float64)
    kernel = torch.exp(-0.5 * ((t[:, None] - t) / width) ** 2)
    total = torch.einsum("ft,tn,tcn->fcn", kernel, known, coefficients)
    share = torch.einsum("ft,tn->fn", kernel, known)[:, None]
    blurred = torch.where(share > 0, total / share.clamp(min=1e-300), 0.0)
    return [
        SplineField(knots, c.view_as(field.coefficients).to(field.coefficients), field.covered)
        for c, field in zip(blurred, fields, strict=True)
    ]


class WindowedField:
    """Fits over overlapping windows of time, blended linearly where two overlap."""

    @checked
    def __init__(self, fields: Sequence[SplineField], windows: Sequence[tuple[float, float]]) -> None:
        self.fields, self.windows = list(fields), list(windows)

    def __call__(self, points: torch.Tensor, outside: float = float("nan")) -> torch.Tensor:
        """Velocity (n, D) in m/s at points (n, D + 1) with the time in s last."""
        points = torch.as_tensor(points)
        share = torch.zeros(len(points), 1, dtype=points.dtype)
        total = torch.zeros(())
        for number, field in enumerate(self.fields):
            weight = self._weight(points[:, -1], number)[:, None]
            weight = torch.where(field.supported(points)[:, None], weight, 0.0)
            total = total + weight * field(points, outside=0.0)
            share = share + weight
        return torch.where(share > 0, total / share.clamp(min=1e-300), outside)

    def _weight(self, t: torch.Tensor, number: int) -> torch.Tensor:
        """1 inside the window, falling to 0 over the overlap with its neighbours."""
        start, end = self.windows[number]
        weight = ((t >= start) & (t <= end)).to(t.dtype)
        if number > 0:
            overlap = self.windows[number - 1][1] - start
            weight = weight * ((t - start) / overlap).clamp(0.0, 1.0)
        if number + 1 < len(self.windows):
            overlap = end - self.windows[number + 1][0]
            weight = weight * ((end - t) / overlap).clamp(0.0, 1.0)
        return weight


def fit_windows(
    smoother: Smoother,
    points: torch.Tensor,
    velocity: torch.Tensor,
    weight: torch.Tensor | None = None,
    wall: WallRows | None = None,
    *,
    length: float,
    overlap: float,
    divergence_points: torch.Tensor | None = None,
) -> WindowedField:
    """Fit a long recording over time in windows of ``length`` s that overlap by ``overlap`` s.

    Memory is that of one window. Arguments as in :meth:`Smoother.fit` with points (n, D + 1).
    """
    points, velocity = dense("points", points), dense("velocity", velocity)
    if points.ndim != 2 or not len(points) or not bool(torch.isfinite(points).all()):
        raise InvalidInput(f"points have shape {tuple(points.shape)}: expected finite (n, D + 1), the time last")
    if not 0 < overlap < length < math.inf:
        raise InvalidInput(f"overlap is {overlap} and length {length}: overlap must lie between 0 and length")
    duration = float(points[:, -1].max() - points[:, -1].min())
    if duration > MOST_WINDOWS * (length - overlap):
        raise InvalidInput(
            f"a window every {length - overlap:g} s over {duration:g} s makes more than {MOST_WINDOWS} of them: are "
            "length, overlap and the points' last column in s?"
        )
    first, last = float(points[:, -1].min()), float(points[:, -1].max())
    lower, upper = points[:, :-1].amin(0), points[:, :-1].amax(0)
    for more in (None if wall is None else wall.points, divergence_points):
        if more is not None:
            lower = torch.minimum(lower, more[:, :-1].amin(0))
            upper = torch.maximum(upper, more[:, :-1].amax(0))
    windows: list[tuple[float, float]] = []
    fields, start = [], first
    while not windows or windows[-1][1] < last:
        end = min(start + length, last)
        box = ([*lower.tolist(), start], [*upper.tolist(), max(end, start + 1e-9)])
        fields.append(_one(smoother, points, velocity, weight, wall, divergence_points, box))
        windows.append((start, end))
        start += length - overlap
    return WindowedField(fields, windows)


def _one(
    smoother: Smoother,
    points: torch.Tensor,
    velocity: torch.Tensor,
    weight: torch.Tensor | None,
    wall: WallRows | None,
    extra: torch.Tensor | None,
    box: tuple[list[float], list[float]],
) -> SplineField:
    def within(t: torch.Tensor) -> torch.Tensor:
        return (t >= box[0][-1]) & (t <= box[1][-1])

    here = within(points[:, -1])
    chosen = None if weight is None else torch.as_tensor(weight)[here]
    walls = None
    if wall is not None and bool(within(wall.points[:, -1]).any()):
        walls = wall.subset(within(wall.points[:, -1]))
    extra = None if extra is None else extra[within(extra[:, -1])]
    return smoother.fit(points[here], velocity[here], chosen, walls, divergence_points=extra, box=box)
