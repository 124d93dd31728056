"""Making the look-up fields of the walls: on a grid, at key times of the motion, for each set of open valves."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import torch
from torch import Tensor

from geometry import Grid, OrificePlane, Surface, WallMotion, grid_winding, orifices
from geometry.motion.key_times import KeyTimes
from torchsph.pairs.smoothing_kernels import SmoothingKernel

from ..state.required import required
from .closest import closest_on_grid
from .completeness import KernelCompleteness
from .displacement import WallDisplacement
from .interface import CompleteWallSample, WallSample
from .look_up import LookUp, by_node

# look-up spacing in particle spacings: half of it resolves the kernel's completeness to a percent (test_walls)
_FIELD_SPACING = 0.5
# distances outside the wall are exact this far (spacings): particles are put back long before
STRAY = 2.0
# this far beyond the kernel's reach (spacings) the kernel is complete and nothing else of the wall is asked for
_FAR = 1.0
# fields kept: the beat is run through in order, and a forecast of 40 ms spans about ten of them
TABLES_KEPT = 12
# cavities kept (a byte a node): a start is seeded with every valve shut, and its first step finds the same times
_CAVITIES = 4
# of small grids more are kept, so that a second beat finds those of the first (bytes)
TABLES_MEMORY = 1 << 27


class WallFields:
    """Distance, normal, wall velocity and (if asked) kernel completeness of moving walls with openings.

    A particle pays one interpolated look-up for all walls. The fields stand at key times of the walls' motion and are
    linear in time between them (the two textures of Grønli 2017, sec. 3.1.3).

    Args:
        motion: the walls (SI).
        spacing: particle spacing, m.
        speed: m/s per internal velocity.
        kernel: of the pair sums.
        smoothing_length: internal; the margin around the walls follows from it and the kernel.
        complete: whether the kernel's completeness and its gradient are wanted.
        device: where the fields are read.
        dtype: of the fields.
        sliding: whether what the walls sweep is wanted as well (``CompleteKernelWall.sliding``).

    Raises:
        geometry.SurfaceError: the walls are open or inside out.
    """

    def __init__(
        self,
        motion: WallMotion,
        spacing: float,
        speed: float,
        kernel: SmoothingKernel,
        smoothing_length: float,
        complete: bool,
        device: str | torch.device,
        dtype: torch.dtype,
        *,
        sliding: bool = False,
    ) -> None:
        motion.surface(float(motion.time[0])).check()
        self.motion, self.spacing, self.speed = motion, spacing, speed
        self.device, self.dtype = device, dtype
        self.key_times = KeyTimes(motion, spacing)
        self.reach = kernel.support * smoothing_length  # internal
        self.grid = self._grid()
        self.dimension = self.grid.dimension
        self.complete, self.sliding = complete, sliding
        self._completeness: KernelCompleteness | None = None
        if complete:
            self._completeness = KernelCompleteness(
                self.grid.shape, _FIELD_SPACING, kernel, smoothing_length, dtype, device
            )
        self._openings = orifices(motion)
        self._made: OrderedDict[tuple[int, tuple[int, ...]], Tensor] = OrderedDict()
        self._cavity: OrderedDict[float, np.ndarray] = OrderedDict()

    def _grid(self) -> Grid:
        every = np.concatenate([self.motion.vertices(t) for t in self.key_times.times])
        margin = (self.reach + 2.0) * self.spacing
        step = _FIELD_SPACING * self.spacing
        return Grid.covering(every.min(0) - margin, every.max(0) + margin, step)

    def key(self, number: int, open_regions: tuple[int, ...]) -> Tensor:
        """Fields at a key time with some regions open.

        Args:
            number: of the key time in ``key_times.times``.
            open_regions: regions of the walls that are no wall.

        Returns:
            (C, *shape), internal; channels: distance, normal (D), wall velocity (D), with ``complete`` completeness and
            its gradient (D), with ``sliding`` what the walls sweep.
        """
        label = (number, open_regions)
        if label in self._made:
            self._made.move_to_end(label)
            return self._made[label]
        self._made[label] = made = self._make(number, open_regions)
        kept = max(TABLES_KEPT, TABLES_MEMORY // (made.numel() * made.element_size()))
        while len(self._made) > kept:
            self._made.popitem(last=False)
        return made

    def displaced(self, number: int, open_regions: tuple[int, ...], displacement: WallDisplacement) -> Tensor:
        """As ``key``, of walls that are displaced: torch can differentiate them in the displacement's amounts."""
        label = (number, open_regions)
        made = displacement.remembered(label)
        if made is None:
            time, plain = self.key_times.times[number], self.key(number, open_regions)
            surface = self.motion.surface(time)
            solid, limit = self._solid(surface, open_regions), self._limit(self._inside(surface, time))
            carried = [closest_on_grid(self.grid, solid, values, limit)[1] for values in displacement.values(surface)]
            d = plain[0] + displacement.outward(carried, plain[0], self.spacing)
            made = displacement.remembered(label, self._channels(d, plain[1 + self.dimension : 1 + 2 * self.dimension]))
        return required(made, "fields that were just made")

    def _make(self, number: int, open_regions: tuple[int, ...]) -> Tensor:
        time = self.key_times.times[number]
        distance, velocity = self._distance(self.motion.surface(time), time, open_regions)
        # to the device first: the transforms are most of what is left to do
        d = torch.from_numpy(distance / self.spacing).to(self.dtype).reshape(self.grid.shape).to(self.device)
        carried = torch.from_numpy(velocity.T / self.speed).to(self.dtype).reshape(-1, *self.grid.shape)
        return self._channels(d, carried.to(self.device))

    def _channels(self, d: Tensor, carried: Tensor) -> Tensor:
        """All fields, from the distance (*shape) and the walls' velocity (D, *shape), internal."""
        channels = [d[None], _normals(d), carried]
        if self._completeness is not None:
            channels.extend(self._completeness.at(d))
            if self.sliding:
                channels.append(self._completeness.swept(d, (carried * channels[1]).sum(0), channels[1]))
        return by_node(torch.cat(channels))

    def _distance(self, surface: Surface, time: float, open_regions: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Distance (n,) from the closed part of the wall, positive in blood and open channels; velocity (n, D).

        Exact inside as far as kernels see and outside as far as particles may stray; farther away a bound does.
        """
        inside = self._inside(surface, time)
        solid, limit = self._solid(surface, open_regions), self._limit(inside)
        distance, carried = closest_on_grid(self.grid, solid, self.motion.velocity(time), limit)
        np.negative(distance, out=distance, where=~inside)
        depth = (self.reach + 2.0) * self.spacing
        for opening in self._openings:
            if opening.label in open_regions:
                channel = _open_channel(distance, self.grid, inside, opening.at(time), depth)
                # the channel goes with its orifice as a whole: a rim that closes in must not squeeze what is beyond it
                carried[channel] = opening.velocity(time)
        return distance, carried

    def _limit(self, inside: np.ndarray) -> np.ndarray:
        """(n,), m: distances below it are exact."""
        return np.where(inside, self.reach + 0.5 + _FIELD_SPACING, STRAY) * self.spacing

    @staticmethod
    def _solid(surface: Surface, open_regions: tuple[int, ...]) -> Surface:
        """The closed part of the wall."""
        shut = ~np.isin(surface.region, open_regions)
        return Surface(surface.vertices, surface.faces[shut], surface.region[shut])

    def _inside(self, surface: Surface, time: float) -> np.ndarray:
        """(n,) bool: nodes inside the walls; remembered for the next set of open valves at the same time."""
        if time not in self._cavity:
            while len(self._cavity) >= _CAVITIES:
                self._cavity.popitem(last=False)
            self._cavity[time] = (grid_winding(self.grid, surface.vertices, surface.faces) > 0).reshape(-1)
        return self._cavity[time]

    def between(self, first: Tensor, second: Tensor) -> LookUp:
        """The fields of two key times made ready for look-ups between them."""
        return LookUp(self.grid, first, second, self.spacing, plain=self.reach + _FAR, directed=True)

    def sample(self, fields: LookUp, fraction: Tensor, position: Tensor) -> WallSample:
        """Walls at particles.

        Args:
            fields: of the two key times around (``between``).
            fraction: (N,) or (), of the time from the first key time to the second.
            position: (N, D), internal.
        """
        values = fields.at(position, fraction)
        d = self.dimension
        distance, normal, velocity = values[:, 0], values[:, 1 : 1 + d], values[:, 1 + d : 1 + 2 * d]
        if not self.complete:
            return WallSample(distance, normal, velocity)
        swept = values[:, 2 + 3 * d] if self.sliding else None
        completeness, gradient = values[:, 1 + 2 * d], values[:, 2 + 2 * d : 2 + 3 * d]
        return CompleteWallSample(distance, normal, velocity, completeness, gradient, swept, values)


def _open_channel(
    distance: np.ndarray, grid: Grid, inside: np.ndarray, opening: OrificePlane, depth: float
) -> np.ndarray:
    """Count the straight channel behind an open orifice as fluid, as far as any kernel sees, in ``distance`` (n,).

    Returns the nodes in the channel and beside it, whose walls are the channel's.
    """
    # the channel lies within this of the orifice's centre
    reach = np.hypot(np.linalg.norm(opening.outline, axis=1).max(), 2.0 * depth)
    first = np.floor((opening.centroid - reach - np.asarray(grid.origin)) / grid.spacing).astype(np.int64)
    last = np.ceil((opening.centroid + reach - np.asarray(grid.origin)) / grid.spacing).astype(np.int64)
    ranges = [np.arange(max(a, 0), min(b + 1, n)) for a, b, n in zip(first, last, grid.shape[::-1], strict=True)]
    index = np.ravel_multi_index(np.ix_(*ranges[::-1]), grid.shape).reshape(-1)
    index = index[~inside[index]]
    place = np.unravel_index(index, grid.shape)[::-1]
    points = torch.from_numpy(np.asarray(grid.origin) + np.stack(place, 1) * np.asarray(grid.spacing))
    height = opening.height(points).numpy()
    near = np.flatnonzero((height > -0.1 * depth) & (height < 2.0 * depth))
    lateral = opening.lateral(points[near]).numpy()
    # beside it as far as an interpolation reaches
    margin = 2.0 * max(grid.spacing)
    lower, upper = opening.outline.min(0) - margin, opening.outline.max(0) + margin
    near = near[((lateral >= lower) & (lateral <= upper)).all(1)]
    inset = opening.lateral_distance(points[near]).numpy()
    over, beside = inset > 0, (inset <= 0) & (inset > -margin) & (height[near] > 0)
    where, outer = index[near[over]], index[near[beside]]
    distance[where] = np.minimum(np.abs(distance[where]), inset[over])
    distance[outer] = np.maximum(distance[outer], inset[beside])
    return np.concatenate([index[near[over & (height[near] > 0)]], outer])


def _normals(distance: Tensor) -> Tensor:
    """Unit gradient of the distance (D, *shape), components x, y, z."""
    gradient = torch.stack(torch.gradient(distance)[::-1])
    length = gradient.square().sum(0).clamp_min(1e-24).sqrt()
    return gradient / length
