"""A packet made ready for tracking: filtered, padded, and in the layout of :mod:`correlation`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from .acquisition import Packet
from .clutter import ClutterFilter
from .correlation import ImagePairs, KernelShape, image_pairs, power
from .fields import box_sum


@dataclass(frozen=True, eq=False)
class Prepared:
    """Filtered images, padded so that every block of nodes fits; all per-axis numbers in array order z, y, x.

    A plane has a z axis of one node. volume (Z, Y, X, T); raw_power, power (Z, Y, X): mean squares over the
    images before and after the filter; finite, inside (Z, Y, X): 1 where all images are finite, and where
    there is an image at all. margin: nodes of padding. spacing (3,): m, 1 along an axis that is not there.
    noise: power of the thermal noise after the filter, if known. turn_gradient (Z, Y, X, 3): see
    :func:`turn_gradient`. active: the axes that are there.
    """

    packet: Packet
    shape: KernelShape
    volume: Tensor
    raw_power: Tensor
    power: Tensor
    finite: Tensor
    inside: Tensor
    margin: tuple[int, int, int]
    spacing: Tensor
    noise: float | None
    turn_gradient: Tensor | None
    active: tuple[int, ...]

    def pairs(self, apart: int) -> ImagePairs:
        return image_pairs(self.volume, apart, self.shape.half)

    def corner(self, nodes: Tensor) -> Tensor:
        """First node (P, 3) in the padded volume of the kernels around unpadded ``nodes`` (P, 3)."""
        return nodes + nodes.new_tensor(self.margin) - nodes.new_tensor(self.shape.half)

    def ramp(self, corner: Tensor) -> Tensor | None:
        """Gradient (P, 3) of the echoes' turn at the middle of kernels."""
        if self.turn_gradient is None:
            return None
        z, y, x = (corner + corner.new_tensor(self.shape.half)).unbind(1)
        return self.turn_gradient[z, y, x]

    def shear(self, corner: Tensor) -> Tensor:
        """Size (P,), 1/s, of the gradient of the axial velocity in kernels; NaN where it was not asked for."""
        ramp = self.ramp(corner)
        if ramp is None:
            return self.power.new_full((len(corner),), math.nan)
        acquisition = self.packet.acquisition
        return (ramp / self.spacing).norm(dim=1) / (acquisition.phase_per_metre * acquisition.interval)

    def holds(self, nodes: Tensor) -> Tensor:
        """Whether kernels around ``nodes`` (P, 3), and one node beyond, lie inside the image: (P,) bool."""
        last = nodes.new_tensor([1] * (3 - self.packet.grid.dimension) + list(self.packet.grid.shape)) - 1
        reach = nodes.new_tensor([h + (h > 0) for h in self.shape.half])
        return ((nodes >= reach) & (nodes + reach <= last)).all(1)

    def nearest_nodes(self, points: Tensor) -> Tensor:
        """Unpadded node numbers (n, 3) of points (n, D), m. ValueError where one lies outside the image."""
        place = self.packet.grid.locate(points.double()).round().long().flip(-1).to(self.volume.device)
        last = torch.tensor(self.packet.grid.shape, device=place.device) - 1
        if bool(((place < 0) | (place > last)).any()):
            raise ValueError("some points to track lie outside the image; select those inside its grid")
        return F.pad(place, (3 - place.shape[1], 0))

    def directions(self, points: Tensor) -> Tensor:
        """Unit vectors (n, 3) along the beams through points (n, D), in array order."""
        beam = self.packet.beams.directions(points.to(self.power)).flip(-1)
        return F.pad(beam, (3 - beam.shape[1], 0))


def prepare(
    packet: Packet, clutter: ClutterFilter | None, *, kernel: float, min_samples: int, reach: float,
    least_images: int, follow_shear: bool,
) -> Prepared:  # fmt: skip
    """Filter and pad a packet for kernels of side ``kernel`` and shifts up to ``reach`` between images, m.

    Raises ValueError where the filter leaves fewer than ``least_images``.
    """
    if len(packet.iq) < 2:
        raise ValueError(f"speckle tracking compares images; the packet has {len(packet.iq)}")
    clean, before = packet.iq, _mean_power(packet.iq)
    finite = torch.isfinite(before)
    if not bool(finite.all()):
        clean, before = torch.where(finite, clean, 0), torch.where(finite, before, 0)
    filtered = clean if clutter is None else clutter.apply(clean)
    after = before if clutter is None else _mean_power(filtered)
    if len(filtered) < least_images:
        raise ValueError(
            f"{len(filtered)} of {len(packet.iq)} images are left after the clutter filter, too few for a "
            f"lag of {least_images - 1}; use a longer packet or a shorter filter"
        )
    spacing = list(reversed(packet.grid.spacing))
    half = [max(round(kernel / (2 * s)), (min_samples - 1) // 2) for s in spacing]
    search = [math.ceil(reach / s + 0.5 - 1e-9) for s in spacing]
    lead = [0] * (3 - packet.grid.dimension)
    shape = KernelShape(tuple(lead + half), tuple(lead + search))
    margin = tuple(h + s for h, s in zip(shape.half, shape.search, strict=True))

    def padded(field: Tensor) -> Tensor:
        edges = [side for m in reversed(margin) for side in (m, m)]
        return F.pad(field.reshape(*[1] * len(lead), *field.shape), edges)

    whole = [n + 2 * m for n, m in zip([1] * len(lead) + list(packet.grid.shape), margin, strict=True)]
    volume = filtered.new_zeros((*whole, len(filtered)))
    middle = tuple(slice(m, n - m) for n, m in zip(whole, margin, strict=True))
    volume[middle] = filtered.reshape(len(filtered), *[1] * len(lead), *packet.grid.shape).movedim(0, -1)
    gain = 1.0 if clutter is None else clutter.noise_gain(len(packet.iq))
    return Prepared(
        packet, shape, volume, padded(before), padded(after),
        padded(finite.to(before)), padded(torch.ones_like(before)), margin,
        torch.tensor([1.0] * len(lead) + spacing, dtype=volume.real.dtype, device=volume.device),
        None if packet.noise is None else packet.noise * gain,
        turn_gradient(volume, shape.half) if follow_shear else None, tuple(range(len(lead), 3)),
    )  # fmt: skip


def _mean_power(images: Tensor) -> Tensor:
    """Mean square (*shape) of images (T, *shape), one at a time to spare memory."""
    total = power(images[0])
    for image in images[1:]:
        total += power(image)
    return total / len(images)


def turn_gradient(volume: Tensor, half: tuple[int, int, int]) -> Tensor:
    """Change along each axis, (Z, Y, X, 3) rad per node, of how much echoes turn from one image to the next.

    The turn is the phase of the lag-one autocorrelation (Kasai et al., IEEE Trans. Sonics Ultrason. 32,
    1985), averaged over twice the kernel: with few numbers taken from the data, little of the speckle's own phase
    gets into them. Nodes weigh by amplitude instead of power, so that neither the brightest speckle nor what is
    left of a wall nearby speaks for all. The change is that to half a kernel further on, either side; from node to
    node it would be that of single speckles, whose nodes turn together whatever the shear.
    """
    turn = torch.linalg.vecdot(volume[..., :-1], volume[..., 1:])  # conjugates the first
    amplitude = torch.linalg.vector_norm(volume, dim=-1)
    turn /= amplitude.clamp_min(torch.finfo(amplitude.dtype).tiny)
    for axis, h in enumerate(half):
        turn = box_sum(turn, 4 * h + 1, axis)
    gradient = volume.real.new_zeros((*turn.shape, 3))
    for axis in (axis for axis in range(3) if half[axis]):
        step = half[axis]
        rest = turn.shape[axis] - step
        change = turn.narrow(axis, 0, rest).conj() * turn.narrow(axis, step, rest)
        both = torch.zeros_like(turn)
        both.narrow(axis, step, rest).add_(change)  # from the node before
        both.narrow(axis, 0, rest).add_(change)  # to the one after
        gradient[..., axis] = both.angle() / step
    return gradient
