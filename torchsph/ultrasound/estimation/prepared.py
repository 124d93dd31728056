"""A packet made ready for tracking: filtered, padded, and in the layout of :mod:`correlation`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..acquisition import Packet
from ..phase import baseband
from .backends import TrackingBackend
from .clutter import ClutterFilter
from .correlation import KernelShape, Triple, triple


@dataclass(frozen=True, eq=False)
class Prepared:
    """Filtered images, padded so that every block of nodes fits; all per-axis numbers in array order z, y, x.

    A plane has a z axis of one node.

    Args:
        packet: what was prepared.
        shape: of kernels and search.
        volume: (Z, Y, X, T), the filtered images.
        raw_power: (Z, Y, X), mean square over the images before the filter.
        power: (Z, Y, X), mean square over the images after it.
        spoilt: (Z, Y, X), 1 where an image is not finite; ``None`` = nowhere.
        margin: (3,), nodes of padding.
        spacing: (3,), m, 1 along an axis that is not there.
        noise: power of the thermal noise after the filter, if known.
        turn: of the echoes from image to image, complex (P,), averaged over a kernel around nodes (P, 3) of the
            padded volume; ``None`` = not asked for.
        wide_turn: the same, averaged over twice a kernel.
        active: the axes that are there.
        backend: who does the sums.
    """

    packet: Packet
    shape: KernelShape
    volume: Tensor
    raw_power: Tensor
    power: Tensor
    spoilt: Tensor | None
    margin: Triple
    spacing: Tensor
    noise: float | None
    turn: Callable[[Tensor], Tensor] | None
    wide_turn: Callable[[Tensor], Tensor] | None
    active: tuple[int, ...]
    backend: TrackingBackend

    @property
    def nodes(self) -> Triple:
        """Nodes per axis of the image without its padding."""
        return triple(n - 2 * m for n, m in zip(self.power.shape, self.margin, strict=True))

    def middle(self, nodes: Tensor) -> Tensor:
        """Nodes (P, 3) of the padded volume that are ``nodes`` (P, 3) of the image."""
        return nodes + nodes.new_tensor(self.margin)

    def corner(self, nodes: Tensor) -> Tensor:
        """First node (P, 3) in the padded volume of the kernels around unpadded ``nodes`` (P, 3)."""
        return self.middle(nodes) - nodes.new_tensor(self.shape.half)

    def kernel_sums(self, field: Tensor, nodes: Tensor) -> Tensor:
        """Sums (P,) over kernels.

        Args:
            field: (Z, Y, X), padded.
            nodes: (P, 3), of the image, in the middle of the kernels.
        """
        return self.backend.box_sums(field, self.middle(nodes), self.shape.half)

    def covered(self, nodes: Tensor) -> Tensor:
        """How many nodes of the image the kernels around ``nodes`` (P, 3) cover along each axis, (P, 3)."""
        half, last = nodes.new_tensor(self.shape.half), nodes.new_tensor(self.nodes) - 1
        return (torch.minimum(nodes + half, last) - (nodes - half).clamp_min(0) + 1).clamp_min(0)

    def ramp(self, nodes: Tensor) -> Tensor | None:
        """Gradient (P, 3), rad per node and image, of how much echoes turn, at ``nodes`` (P, 3).

        The turn is the phase of the lag-one autocorrelation (Kasai et al. 1985), averaged over twice the kernel: with
        few numbers taken from the data, little of the speckle's own phase gets into them. Nodes weigh by amplitude
        instead of power, so that neither the brightest speckle nor what is left of a wall nearby speaks for all. Its
        change is that to half a kernel further on, either side; from node to node it would be that of single speckles,
        whose nodes turn together whatever the shear.
        """
        if self.wide_turn is None:
            return None
        gradient = self.power.new_zeros((len(nodes), 3))
        for axis, (before, after) in self._changes(self.wide_turn, nodes).items():
            gradient[:, axis] = (before + after).angle() / self.shape.half[axis]
        return gradient

    def _changes(self, turn: Callable[[Tensor], Tensor], nodes: Tensor) -> dict[int, tuple[Tensor, Tensor]]:
        """By axis, how ``turn`` changes from half a kernel before to ``nodes`` (P, 3), and from there on; complex."""
        middle = self.middle(nodes)
        in_middle, changes = turn(middle), {}
        for axis in self.active:
            step = torch.zeros_like(middle)
            step[:, axis] = self.shape.half[axis]
            changes[axis] = turn(middle - step).conj() * in_middle, in_middle.conj() * turn(middle + step)
        return changes

    def shear(self, ramp: Tensor | None, points: int) -> Tensor:
        """Size (points,), 1/s, of the gradient of the axial velocity; NaN where it was not asked for.

        Args:
            ramp: (points, 3), rad per node and image, see :meth:`ramp`.
            points: how many there are.
        """
        if ramp is None:
            return self.power.new_full((points,), math.nan)
        acquisition = self.packet.acquisition
        return (ramp / self.spacing).norm(dim=1) / (acquisition.phase_per_metre * acquisition.interval)

    def bend(self, nodes: Tensor) -> Tensor:
        """How far the axial velocity half a kernel further on, either side, is off a straight line, (P,), m/s.

        All axes together, from the turn of single kernels; NaN where it was not asked for. A kernel's mean
        is off its middle by as much, whatever the gradient.
        """
        if self.turn is None:
            return self.power.new_full((len(nodes),), math.nan)
        parts = [(before.conj() * after).angle() for before, after in self._changes(self.turn, nodes).values()]
        acquisition = self.packet.acquisition
        return torch.stack(parts).norm(dim=0) / (acquisition.phase_per_metre * acquisition.interval)

    def holds(self, nodes: Tensor) -> Tensor:
        """Whether kernels around ``nodes`` (P, 3), and one node beyond, lie inside the image: (P,) bool."""
        last = nodes.new_tensor(self.nodes) - 1
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
    packet: Packet,
    clutter: ClutterFilter | None,
    *,
    kernel: float,
    min_samples: int,
    reach: float,
    least_images: int,
    follow_shear: bool,
    backend: TrackingBackend,
) -> Prepared:
    """Filter and pad a packet.

    Args:
        packet: IQ images.
        clutter: filter over the packet; ``None`` = already filtered.
        kernel: m, side of a kernel.
        min_samples: nodes per axis that a kernel needs.
        reach: m, greatest shift between the images compared.
        least_images: that are needed after the filter.
        follow_shear: whether the turn of the echoes from image to image is needed.
        backend: who does the sums.

    Raises:
        ValueError: where the filter leaves fewer than ``least_images``, or the packet's phase fits no convention.
    """
    if len(packet.iq) < 2:
        raise ValueError(f"speckle tracking compares images; the packet has {len(packet.iq)}")
    packet = baseband(packet)
    spacing = list(reversed(packet.grid.spacing))
    half = [max(round(kernel / (2 * s)), (min_samples - 1) // 2) for s in spacing]
    search = [math.ceil(reach / s + 0.5 - 1e-9) for s in spacing]
    lead = [0] * (3 - packet.grid.dimension)
    shape = KernelShape(triple(lead + half), triple(lead + search))
    margin = triple(h + s for h, s in zip(shape.half, shape.search, strict=True))

    def solid(images: Tensor) -> Tensor:
        return images.reshape(len(images), *[1] * len(lead), *packet.grid.shape)

    def padded(field: Tensor) -> Tensor:
        return F.pad(field, [side for m in reversed(margin) for side in (m, m)])

    clean, before = packet.iq, backend.mean_power(solid(packet.iq))
    finite = torch.isfinite(before)
    spoilt = None
    if not bool(finite.all()):
        spoilt = padded((~finite).to(before))
        clean, before = torch.where(finite.view(packet.grid.shape), clean, 0), torch.where(finite, before, 0)
    filtered = clean if clutter is None else clutter.apply(clean)
    if len(filtered) < least_images:
        raise ValueError(
            f"{len(filtered)} of {len(packet.iq)} images are left after the clutter filter, too few for a "
            f"lag of {least_images - 1}; use a longer packet or a shorter filter"
        )
    volume, after, turn = backend.arrange(solid(filtered), margin, turns=follow_shear)
    averages: tuple[Callable[[Tensor], Tensor], ...] | tuple[None, None] = (None, None)
    if turn is not None:
        averages = tuple(backend.sums_around(turn, triple(size * h for h in shape.half)) for size in (1, 2))
    gain = 1.0 if clutter is None else clutter.noise_gain(len(packet.iq))
    return Prepared(
        packet=packet,
        shape=shape,
        volume=volume,
        raw_power=after if clutter is None else padded(before),
        power=after,
        spoilt=spoilt,
        margin=margin,
        spacing=torch.tensor([1.0] * len(lead) + spacing, dtype=after.dtype, device=after.device),
        noise=None if packet.noise is None else packet.noise * gain,
        turn=averages[0],
        wide_turn=averages[1],
        active=tuple(range(len(lead), 3)),
        backend=backend,
    )
