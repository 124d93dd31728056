"""A recording's flow, seen by a simulated scanner: what speckle and Doppler measurements have in common."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from geometry import Grid, Recording

from ..acquisition import Acquisition, Beams, Packet
from ..estimation.clutter import CLUTTER_FILTERS, ClutterFilter
from ..scanner.echoes import EchoModel, simulate_packet
from ..scanner.flow import RecordingFlow
from ..scanner.pointspread import GaussianPointSpread, SectorPointSpread
from .noise import frame_seed


@dataclass(frozen=True)
class ScannerOptions:
    """The simulated scanner: what is common to speckle and Doppler measurements.

    Args:
        every: measure each K-th frame.
        snr: dB, blood over thermal noise.
        tissue: dB, echogenicity over blood, outside the blood.
        clutter: dB, still echoes over blood, within it; ``None`` = none.
        frequency: Hz, see :class:`Acquisition`.
        sound_speed: m/s.
        prf: Hz, how often an image is taken.
        packet: images taken in a row for one estimate.
        axial_width: m, FWHM of the point spread along the beam.
        lateral_width: m, the same across it; with an ``apex`` that at ``depth``, growing with it.
        image_spacing: m, between samples of the image (made to divide the recording's spacing).
        clutter_filter: fir, polynomial, svd or none.
        beam: (D,), direction of the beams, x, y, z; ``None`` = along the last axis.
        apex: (D,), m, of a sector, from which the beams fan out around ``beam``; ``None`` = parallel beams.
        depth: m, where a sector's beams are ``lateral_width`` wide.
        device: for torch.
    """

    every: int = 1
    snr: float = 20.0
    tissue: float = 40.0
    clutter: float | None = None
    frequency: float = 5e6
    sound_speed: float = 1540.0
    prf: float = 4e3
    packet: int = 16
    axial_width: float = 0.5e-3
    lateral_width: float = 1.2e-3
    image_spacing: float = 1e-3 / 6
    clutter_filter: str = "fir"
    beam: tuple[float, ...] | None = None
    apex: tuple[float, ...] | None = None
    depth: float = 50e-3
    device: str = "cpu"

    def __post_init__(self) -> None:
        if isinstance(self.every, bool) or not isinstance(self.every, int) or self.every < 1:
            raise ValueError(f"every must be a whole number >= 1, got {self.every!r}")
        if not (math.isfinite(self.image_spacing) and self.image_spacing > 0):
            raise ValueError(f"image_spacing must be positive and finite, got {self.image_spacing!r}")
        if self.clutter_filter not in (*CLUTTER_FILTERS, "none"):
            known = ", ".join((*CLUTTER_FILTERS, "none"))
            raise ValueError(f"clutter_filter must be one of {known}, got {self.clutter_filter!r}")
        for name in ("beam", "apex"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, tuple(float(part) for part in getattr(self, name)))
        self.echo_model(len(self.beam or self.apex or (0,) * 3))  # its parts check the rest
        filtering = self.filter()
        if filtering is not None:
            filtering.apply(torch.zeros((self.packet, 1), dtype=torch.complex64))  # a packet too short says so

    def filter(self) -> ClutterFilter | None:
        """The clutter filter of that name, ``None`` = none."""
        return None if self.clutter_filter == "none" else CLUTTER_FILTERS[self.clutter_filter]()

    def summary(self) -> str:
        """The settings in words, for the description of a recording."""
        return (
            f"{self.frequency / 1e6:g} MHz, PRF {self.prf:g} Hz, packet {self.packet}, SNR {self.snr:g} dB, "
            f"tissue {self.tissue:g} dB, clutter filter {self.clutter_filter}"
        )

    def echo_model(self, dimension: int) -> EchoModel:
        """The scanner in a space of ``dimension``; ValueError where the beam has another one."""
        direction = self.beam or (0.0,) * (dimension - 1) + (1.0,)
        if len(direction) != dimension:
            raise ValueError(f"beam has {len(direction)} components, the recording {dimension}")
        shape: GaussianPointSpread | SectorPointSpread = GaussianPointSpread(self.axial_width, self.lateral_width)
        if self.apex is not None:
            shape = SectorPointSpread(self.axial_width, self.lateral_width, self.depth)
        return EchoModel(
            Acquisition(self.frequency, self.sound_speed, self.prf, self.packet),
            shape,
            Beams(direction, self.apex),
            self.snr,
            self.tissue,
            self.clutter,
        )

    def spacing(self, grid: Grid) -> tuple[float, ...]:
        """Image spacing, x, y, z: the nearest that makes the recording's nodes image nodes."""
        return tuple(step / max(1, round(step / self.image_spacing)) for step in grid.spacing)


def scanned(
    true: Recording,
    options: ScannerOptions,
    models: list[EchoModel],
    seed: int,
    margin: float,
    *,
    progress: bool,
) -> Iterator[tuple[int, Tensor, list[Packet]]]:
    """Scan the frames to be measured, one after the other.

    All packets of a frame show the same scatterers in the same noise-free motion. Frames without blood give no
    points and no packets.

    Args:
        true: the flow.
        options: which frames, and the image's spacing.
        models: a packet is made for each of them.
        seed: of scatterers and noise, >= 0.
        margin: m, of image around the points.
        progress: whether to show a bar.

    Yields:
        Number of the frame, the points (n, D), m, inside its mask, and a packet of each model.
    """
    flow = RecordingFlow(true, device=options.device)
    nodes = true.grid.nodes()
    frames = range(0, true.frames, options.every)
    for frame in tqdm(frames, "scan", disable=None if progress else True):
        points = nodes[torch.from_numpy(np.ascontiguousarray(true.mask[frame]).reshape(-1))]
        if not len(points):
            yield frame, points, []
            continue
        grid = image_grid(true.grid, points, options.spacing(true.grid), margin)
        packets = []
        for model in models:
            generator = torch.Generator(options.device).manual_seed(frame_seed(seed, frame))
            packets.append(simulate_packet(flow, grid, model, float(true.time[frame]), generator))
        yield frame, points, packets


def image_grid(grid: Grid, points: Tensor, spacing: tuple[float, ...], margin: float) -> Grid:
    """The image grid around some nodes of a grid, whose own nodes include them.

    Args:
        grid: of the points.
        points: (n, D), m, nodes of ``grid``.
        spacing: (D,), m, of the image, of which those of ``grid`` are multiples.
        margin: m, of image around the points.
    """
    extra = [math.ceil(margin / step) for step in spacing]
    lower, upper = points.amin(0).tolist(), points.amax(0).tolist()
    shape = [round((b - a) / s) + 1 + 2 * e for a, b, s, e in zip(lower, upper, spacing, extra, strict=True)]
    origin = tuple(a - e * s for a, e, s in zip(lower, extra, spacing, strict=True))
    return Grid(origin, spacing, tuple(reversed(shape)))


@dataclass(eq=False)
class Canvas:
    """Arrays of a measurement being filled frame by frame; nothing is measured until it is.

    Args:
        true: what is measured.
        frames: numbers of the frames that are.
    """

    true: Recording
    frames: list[int]

    def __post_init__(self) -> None:
        shape = self.true.velocity.shape[1:]
        self.velocity = np.zeros((len(self.frames), *shape), np.float32)
        self.sigma = np.zeros((len(self.frames), *shape), np.float32)
        self.weight = np.zeros((len(self.frames), *shape[1:]), np.float32)

    def paint(self, frame: int, velocity: Tensor, sigma: Tensor, weight: Tensor) -> None:
        """Write the estimates of a frame at its mask's n nodes; without weight the velocity is 0.

        Args:
            frame: its number in ``true``.
            velocity: (n, D), m/s.
            sigma: (n, D), m/s, its standard deviation.
            weight: (n,), from 0 to 1.
        """
        row, mask = self.frames.index(frame), self.true.mask[frame]
        seen = (weight > 0).cpu()
        self.velocity[row][:, mask] = torch.where(seen[:, None], velocity.cpu(), 0).T.numpy()
        self.sigma[row][:, mask] = sigma.cpu().T.numpy()
        self.weight[row][mask] = weight.cpu().numpy()

    def recording(self, description: str, beams: Beams | None = None) -> Recording:
        """The measurement; with ``beams``, one of the velocity along them alone."""
        base = self.true.select(self.frames).with_velocity(self.velocity, sigma=self.sigma, description=description)
        if beams is None:
            return replace(base, weight=self.weight)
        along = beams.directions(self.true.grid.nodes()).T.numpy()
        return replace(base, weight=self.weight, beam=along.reshape(-1, *self.true.grid.shape))
