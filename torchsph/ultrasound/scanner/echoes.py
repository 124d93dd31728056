"""A packet of IQ images of a flow: scatterers moved, imaged and drowned in thermal noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch

from geometry import Grid

from ..acquisition import Acquisition, Beams, IQPhase, Packet
from .flow import Flow
from .image import Imager, ParallelImager
from .pointspread import GaussianPointSpread, PointSpread, SectorPointSpread
from .scatterers import Box, Cloud, carry, reseed, seed_cloud
from .sector import SectorImager


@dataclass(frozen=True)
class EchoModel:
    """Options of :func:`simulate_packet`.

    Args:
        acquisition: timing and wave.
        pointspread: a :class:`SectorPointSpread` for beams from an apex, any other for parallel ones.
        beams: where the beams point.
        snr: dB, blood speckle power over thermal noise power; ``None`` = no noise.
        tissue: dB, echogenicity of tissue over blood; ``None`` = tissue is silent.
        clutter: dB, stationary echo power over blood power inside the blood (reverberation, side lobes);
            ``None`` = none.
        clutter_velocity: (D,), m/s, of the clutter; ``None`` = still.
        density: scatterers per integral of the point spread's square. The intensity's normalised second moment
            is then above that of fully developed speckle, 2, by about 0.35 / density in space (0.5 in a plane).
    """

    acquisition: Acquisition = Acquisition()
    pointspread: PointSpread | SectorPointSpread = field(default_factory=GaussianPointSpread)
    beams: Beams = Beams()
    snr: float | None = 20.0
    tissue: float | None = 40.0
    clutter: float | None = None
    clutter_velocity: tuple[float, ...] | None = None
    density: float = 5.0

    def __post_init__(self) -> None:
        for name in ("snr", "tissue", "clutter"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name} must be a finite number of dB or None, got {value!r}")
        if isinstance(self.pointspread, SectorPointSpread) != (self.beams.apex is not None):
            raise ValueError("beams from an apex need a SectorPointSpread, and parallel beams another one")
        if not (math.isfinite(self.density) and self.density > 0):
            raise ValueError(f"density must be positive, got {self.density!r}")


def simulate_packet(
    flow: Flow,
    grid: Grid,
    model: EchoModel,
    time: float,
    generator: torch.Generator,
    *,
    dtype: torch.dtype = torch.float32,
) -> Packet:
    """IQ images of a flow, of blood power 1.

    Scatterers are seeded afresh at the first image and reseeded at every following one where they leave or
    thin out. Runs on the generator's device.

    Args:
        flow: what moves the scatterers, and which of them are blood.
        grid: the image grid.
        model: options of scanner and echoes.
        time: s, the middle of the packet.
        generator: draws scatterers and noise.
        dtype: precision of the samples' parts.

    Raises:
        ValueError: where beams and grid differ in dimension.
    """
    if model.beams.dimension != grid.dimension:
        raise ValueError(f"beams are {model.beams.dimension}-D, the grid {grid.dimension}-D")
    acquisition = model.acquisition
    imager, box = make_imager(grid, model, dtype, generator.device), _box(grid, model)
    energy = torch.as_tensor(imager.energy)
    density = model.density / float(energy.min())  # where the point spread is smallest
    start = time - 0.5 * (acquisition.packet - 1) * acquisition.interval
    cloud = seed_cloud(box, flow, start, density, generator, dtype=dtype)
    haze = None
    if model.clutter is not None:
        haze = seed_cloud(box, flow, start, density, generator, dtype=dtype)
        haze = replace(haze, amplitude=haze.amplitude * 10 ** (model.clutter / 20))
    # density * energy is the speckle power of unit amplitudes, so this makes the blood's power 1 everywhere
    scale = 1 / (density * energy).sqrt()
    noise = 0.0 if model.snr is None else 10 ** (-model.snr / 10)
    images = torch.empty((acquisition.packet, *grid.shape), dtype=dtype.to_complex(), device=generator.device)
    for number in range(acquisition.packet):
        image_time = start + number * acquisition.interval
        position, amplitude = cloud.position, _echogenicity(cloud, model)
        if haze is not None:
            shift = haze.position.new_tensor(model.clutter_velocity or (0.0,) * grid.dimension)
            position = torch.cat([position, haze.position + shift * (image_time - time)])
            amplitude = torch.cat([amplitude, haze.amplitude])
        images[number] = imager.noisy_image(position, amplitude, scale, noise, generator)
        if number + 1 < acquisition.packet:
            cloud = carry(cloud, box, flow, image_time, acquisition.interval, density, generator)
            cloud = reseed(cloud, box, flow, image_time + acquisition.interval, density, generator)
    return Packet(images, grid, acquisition, model.beams, noise, IQPhase.BASEBAND)


def make_imager(
    grid: Grid, model: EchoModel, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Imager:
    """The imager for the model's beams."""
    if isinstance(model.pointspread, SectorPointSpread):
        return SectorImager(grid, model.pointspread, model.acquisition, model.beams, dtype=dtype, device=device)
    return ParallelImager(grid, model.pointspread, model.acquisition, model.beams, dtype=dtype, device=device)


def _box(grid: Grid, model: EchoModel) -> Box:
    """The grid's box and what lies within reach of the point spread around it."""
    if isinstance(model.pointspread, SectorPointSpread):
        # as for parallel beams of the farthest corner's width, whatever their direction
        farthest, spread = float(model.beams.depth(grid.nodes()).max()), model.pointspread
        widest = GaussianPointSpread(spread.axial, spread.lateral * farthest / spread.depth)
        reach: tuple[float, ...] = (max(widest.reach(model.beams.direction)),) * grid.dimension
    else:
        reach = model.pointspread.reach(model.beams.direction)
    lower = tuple(a - r for a, r in zip(grid.origin, reach, strict=True))
    return Box(lower, tuple(b + r for b, r in zip(grid.upper, reach, strict=True)))


def _echogenicity(cloud: Cloud, model: EchoModel) -> torch.Tensor:
    bright = 0.0 if model.tissue is None else 10 ** (model.tissue / 20)
    return torch.where(cloud.tissue, cloud.amplitude * bright, cloud.amplitude)
