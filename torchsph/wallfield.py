"""Making the look-up fields of the walls: on a grid, at key frames of the motion, for each set of open valves."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn import functional

from geometry import Grid, OrificePlane, Surface, WallMotion, grid_winding, orifices
from geometry.closest import SurfaceIndex

from .lookup import LookUp
from .smoothing import SmoothingKernel
from .walls import WallSample

# look-up spacing in particle spacings: half of it resolves the kernel's share to a percent (test_walls)
_FIELD_SPACING = 0.5
# distances outside the wall are exact this far (spacings): particles are put back long before
_STRAY = 1.5
# key frames kept: the beat is run through in order, and a forecast of 40 ms spans about ten of them
_KEPT = 24


class WallFields:
    """Distance, normal, wall velocity and (if asked) kernel share of moving walls with openings.

    Args:
        motion: the walls (SI). spacing: particle spacing, m. speed: m/s per internal velocity.
        kernel, smoothing_length: of the pair sums, internal length; the margin around the walls follows from them.
        complete: whether the kernel's share and its gradient are wanted.
    """

    def __init__(
        self, motion: WallMotion, spacing: float, speed: float, kernel: SmoothingKernel, smoothing_length: float,
        complete: bool, device: str | torch.device, dtype: torch.dtype,
    ) -> None:
        self.motion, self.spacing, self.speed = motion, spacing, speed
        self.kernel, self.smoothing_length, self.complete = kernel, smoothing_length, complete
        self.device, self.dtype = device, dtype
        self.reach = kernel.support * smoothing_length  # internal
        self.grid = self._grid()
        self.dimension = self.grid.dimension
        self._openings = orifices(motion)
        self._made: OrderedDict[tuple[int, tuple[int, ...]], Tensor] = OrderedDict()

    def _grid(self) -> Grid:
        every = np.concatenate([self.motion.vertices(t) for t in self.motion.time])
        margin = (self.reach + 2.0) * self.spacing
        step = _FIELD_SPACING * self.spacing
        return Grid.covering(every.min(0) - margin, every.max(0) + margin, step)

    def key(self, frame: int, open_regions: tuple[int, ...]) -> Tensor:
        """Fields at key frame ``frame`` with some regions open: (C, *shape), internal units.

        Channels: distance, normal (D), wall velocity (D), and with ``complete`` share, share gradient (D).
        """
        label = (frame, open_regions)
        if label in self._made:
            self._made.move_to_end(label)
            return self._made[label]
        self._made[label] = self._make(frame, open_regions)
        while len(self._made) > _KEPT:
            self._made.popitem(last=False)
        return self._made[label]

    def _make(self, frame: int, open_regions: tuple[int, ...]) -> Tensor:
        time = float(self.motion.time[frame])
        surface = self.motion.surface(time)
        distance, velocity = self._distance(surface, time, open_regions)
        shape = self.grid.shape
        d = torch.from_numpy(distance).reshape(shape) / self.spacing
        channels = [d[None], _normals(d), torch.from_numpy(velocity.T / self.speed).reshape(-1, *shape)]
        if self.complete:
            channels.extend(kernel_share(d, _FIELD_SPACING, self.kernel, self.smoothing_length))
        return torch.cat(channels).to(self.dtype).to(self.device)

    def _distance(
        self, surface: Surface, time: float, open_regions: tuple[int, ...]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distance (n,) from the closed part of the wall, positive in blood and open channels; velocity (n, D)."""
        nodes = self.grid.nodes().numpy()
        inside = grid_winding(self.grid, surface.vertices, surface.faces) > 0
        shut = ~np.isin(surface.region, open_regions)
        solid = Surface(surface.vertices, surface.faces[shut], surface.region[shut])
        near, donor = self._band(inside)
        found = SurfaceIndex(solid, self.spacing * _FIELD_SPACING).query(nodes[near])
        carried = found.interpolate(solid, self.motion.velocity(time))[donor]
        magnitude = found.distance[donor]
        beyond = np.ones(len(nodes), bool)
        beyond[near] = False
        magnitude[beyond] += np.linalg.norm(nodes[beyond] - nodes[near[donor[beyond]]], axis=1)
        inside = inside.reshape(-1)
        distance = np.where(inside, magnitude, -magnitude)
        depth = (self.reach + 2.0) * self.spacing
        for opening in self._openings:
            if opening.label in open_regions:
                distance = _with_channel(distance, nodes, inside, opening.at(time), depth)
        return distance, carried

    def _band(self, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes near enough to the wall to need the exact distance, and for every node the nearest of them.

        Inside as far as kernels see, outside as far as particles may stray; farther away a bound does.
        """
        step = _FIELD_SPACING
        depth = np.where(inside, distance_transform_edt(inside), distance_transform_edt(~inside)) * step
        close = depth < np.where(inside, self.reach + 0.5 + step, _STRAY + step)
        donor = distance_transform_edt(~close, return_distances=False, return_indices=True)
        number = np.cumsum(close.reshape(-1)) - 1
        flat = np.ravel_multi_index(tuple(donor), close.shape).reshape(-1)
        return np.flatnonzero(close), number[flat]

    def between(self, first: Tensor, second: Tensor) -> LookUp:
        """The fields of two key frames made ready for look-ups between them."""
        return LookUp(self.grid, first, second, self.spacing)

    def sample(self, fields: LookUp, fraction: Tensor, position: Tensor) -> WallSample:
        """Walls at positions (N, D), internal; ``fraction`` (N,) or () of the way from the first key frame."""
        values = fields.at(position, fraction)
        d = self.dimension
        normal = functional.normalize(values[:, 1 : 1 + d], dim=1)
        sample = (values[:, 0], normal, values[:, 1 + d : 1 + 2 * d])
        if not self.complete:
            return WallSample(*sample)
        return WallSample(*sample, values[:, 1 + 2 * d], values[:, 2 + 2 * d :])


def _with_channel(
    distance: np.ndarray, nodes: np.ndarray, inside: np.ndarray, opening: OrificePlane, depth: float
) -> np.ndarray:
    """Count the straight channel behind an open orifice as fluid, as far as any kernel sees."""
    height = opening.height(torch.from_numpy(nodes)).numpy()
    near = np.flatnonzero(~inside & (height > -0.1 * depth) & (height < 2.0 * depth))
    lateral = opening.lateral_distance(torch.from_numpy(nodes[near])).numpy()
    # beside the channel the rim, a part of the solid faces, already gives the distance
    inner = lateral > 0
    where = near[inner]
    distance[where] = np.minimum(np.abs(distance[where]), lateral[inner])
    return distance


def _normals(distance: Tensor) -> Tensor:
    """Unit gradient of the distance (D, *shape), components x, y, z."""
    gradient = torch.gradient(distance)
    return functional.normalize(torch.stack(gradient[::-1]), dim=0)


def kernel_share(
    distance: Tensor, step: float, kernel: SmoothingKernel, smoothing_length: float
) -> tuple[Tensor, Tensor]:
    """Integral of the kernel over the fluid, and its gradient, at every node of a signed distance.

    The fluid's indicator, smoothed over one cell as a plane wall would be, is convolved with the kernel and with its
    gradient; edges, gaps and curvature are therefore contained (Ferrand et al. 2013 evaluate the same integrals face
    by face).

    Args:
        distance: (*shape), positive inside. step: node spacing; both in the unit of ``smoothing_length``.

    Returns:
        share (1, *shape) in [0, 1] and its gradient (D, *shape) with components x, y, z.
    """
    indicator = (0.5 + distance / step).clamp(0.0, 1.0).double()
    dimension = distance.ndim
    reach = int(np.ceil(kernel.support * smoothing_length / step))
    axis = torch.arange(-reach, reach + 1, dtype=torch.float64) * step
    mesh = torch.stack(torch.meshgrid(*[axis] * dimension, indexing="ij"))
    radius = mesh.norm(dim=0)
    weight = kernel.value(radius, smoothing_length, dimension)
    slope = kernel.gradient_factor(radius, smoothing_length, dimension) * mesh
    # discrete normalisation: a full neighbourhood has share 1, a linear indicator the right slope
    weight = weight / weight.sum()
    slope = slope / -(slope[0] * mesh[0]).sum()
    filters = _sharpened(torch.cat([weight[None], slope.flip(0)]))
    reach += 1
    # the gradient of the share at x is the sum over y of grad W(x - y): odd in the offset x - y
    result = _convolve(indicator, filters, reach)
    return result[:1].clamp(0.0, 1.0), result[1:]


def _sharpened(filters: Tensor) -> Tensor:
    """(1 - laplacian / 24) of filters (F, *k), one node larger: undoes the cell-wide smoothing of the indicator.

    A box of one cell passes the wave number k with 1 - k^2 / 24 + ... (k per node), whatever the wall's direction.
    """
    dimension = filters.ndim - 1
    wide = functional.pad(filters, (1,) * (2 * dimension))
    laplacian = -2.0 * dimension * wide
    for axis in range(1, dimension + 1):
        laplacian = laplacian + wide.roll(1, axis) + wide.roll(-1, axis)
    return wide - laplacian / 24.0


def _convolve(field: Tensor, filters: Tensor, reach: int) -> Tensor:
    """Convolution of (*shape) with each of (F, *k) by FFT, edges continued: (F, *shape)."""
    dimension = field.ndim
    padded = functional.pad(field[None, None], (reach,) * (2 * dimension), mode="replicate")[0, 0]
    size = padded.shape
    axes = tuple(range(1, dimension + 1))
    product = torch.fft.rfftn(padded[None], dim=axes) * torch.fft.rfftn(filters, s=size, dim=axes)
    full = torch.fft.irfftn(product, s=size, dim=axes)
    inner = (slice(None), *(slice(2 * reach, 2 * reach + n) for n in field.shape))
    return full[inner]
