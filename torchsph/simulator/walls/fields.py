"""Making the look-up fields of the walls: on a grid, at moments of the motion, for each set of open valves."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import torch
from torch import Tensor

from geometry import Grid, OrificePlane, Surface, WallMotion, grid_winding, orifices
from torchsph.pairs.smoothing_kernels import SmoothingKernel

from .closest import closest_on_grid
from .forces import WallSample
from .kernel_share import KernelShare
from .key_times import Moments
from .look_up import LookUp, by_node

# look-up spacing in particle spacings: half of it resolves the kernel's share to a percent (test_walls)
_FIELD_SPACING = 0.5
# distances outside the wall are exact this far (spacings): particles are put back long before
_STRAY = 2.0
# this far beyond the kernel's reach (spacings) the share is 1 and nothing else of the wall is asked for
_FAR = 1.0
# fields kept: the beat is run through in order, and a forecast of 40 ms spans about ten of them
_KEPT = 24
# of small grids more are kept, so that a second beat finds those of the first (bytes)
_MEMORY = 1 << 29


class WallFields:
    """Distance, normal, wall velocity and (if asked) kernel share of moving walls with openings.

    Args:
        motion: the walls (SI). spacing: particle spacing, m. speed: m/s per internal velocity.
        kernel, smoothing_length: of the pair sums, internal length; the margin around the walls follows from them.
        complete: whether the kernel's share and its gradient are wanted.
        sliding: whether what the walls sweep is wanted as well (``CompleteKernelWall.sliding``).

    Raises geometry.SurfaceError for walls that are open or inside out.
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
        self.moments = Moments(motion, spacing)
        self.reach = kernel.support * smoothing_length  # internal
        self.grid = self._grid()
        self.dimension = self.grid.dimension
        self.complete, self.sliding = complete, sliding
        self._share: KernelShare | None = None
        if complete:
            self._share = KernelShare(self.grid.shape, _FIELD_SPACING, kernel, smoothing_length, dtype)
        self._openings = orifices(motion)
        self._made: OrderedDict[tuple[int, tuple[int, ...]], Tensor] = OrderedDict()

    def _grid(self) -> Grid:
        every = np.concatenate([self.motion.vertices(t) for t in self.moments.times])
        margin = (self.reach + 2.0) * self.spacing
        step = _FIELD_SPACING * self.spacing
        return Grid.covering(every.min(0) - margin, every.max(0) + margin, step)

    def key(self, moment: int, open_regions: tuple[int, ...]) -> Tensor:
        """Fields at a moment (a number of ``moments.times``) with some regions open: (C, *shape), internal units.

        Channels: distance, normal (D), wall velocity (D), with ``complete`` share, share gradient (D), with
        ``sliding`` what the walls sweep.
        """
        label = (moment, open_regions)
        if label in self._made:
            self._made.move_to_end(label)
            return self._made[label]
        self._made[label] = made = self._make(moment, open_regions)
        kept = max(_KEPT, _MEMORY // (made.numel() * made.element_size()))
        while len(self._made) > kept:
            self._made.popitem(last=False)
        return made

    def _make(self, moment: int, open_regions: tuple[int, ...]) -> Tensor:
        time = self.moments.times[moment]
        distance, velocity = self._distance(self.motion.surface(time), time, open_regions)
        d = torch.from_numpy(distance / self.spacing).to(self.dtype).reshape(self.grid.shape)
        carried = torch.from_numpy(velocity.T / self.speed).to(self.dtype).reshape(-1, *self.grid.shape)
        channels = [d[None], _normals(d), carried]
        if self._share is not None:
            channels.extend(self._share.at(d))
            if self.sliding:
                channels.append(self._share.swept(d, (carried * channels[1]).sum(0), channels[1]))
        return by_node(torch.cat(channels).to(self.device))

    def _distance(self, surface: Surface, time: float, open_regions: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Distance (n,) from the closed part of the wall, positive in blood and open channels; velocity (n, D).

        Exact inside as far as kernels see and outside as far as particles may stray; farther away a bound does.
        """
        inside = (grid_winding(self.grid, surface.vertices, surface.faces) > 0).reshape(-1)
        shut = ~np.isin(surface.region, open_regions)
        solid = Surface(surface.vertices, surface.faces[shut], surface.region[shut])
        limit = np.where(inside, self.reach + 0.5 + _FIELD_SPACING, _STRAY) * self.spacing
        distance, carried = closest_on_grid(self.grid, solid, self.motion.velocity(time), limit)
        np.negative(distance, out=distance, where=~inside)
        depth = (self.reach + 2.0) * self.spacing
        for opening in self._openings:
            if opening.label in open_regions:
                channel = _open_channel(distance, self.grid, inside, opening.at(time), depth)
                # the channel goes with its orifice as a whole: a rim that closes in must not squeeze what is beyond it
                carried[channel] = opening.velocity(time)
        return distance, carried

    def between(self, first: Tensor, second: Tensor) -> LookUp:
        """The fields of two key frames made ready for look-ups between them."""
        return LookUp(self.grid, first, second, self.spacing, plain=self.reach + _FAR, directed=True)

    def sample(self, fields: LookUp, fraction: Tensor, position: Tensor) -> WallSample:
        """Walls at positions (N, D), internal; ``fraction`` (N,) or () of the way from the first key frame."""
        values = fields.at(position, fraction)
        d = self.dimension
        sample = (values[:, 0], values[:, 1 : 1 + d], values[:, 1 + d : 1 + 2 * d])
        if not self.complete:
            return WallSample(*sample)
        swept = values[:, 2 + 3 * d] if self.sliding else None
        return WallSample(*sample, values[:, 1 + 2 * d], values[:, 2 + 2 * d : 2 + 3 * d], swept, values)


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
    length = gradient.square().sum(0).sqrt_()
    return gradient.div_(length.clamp_min_(1e-12))
