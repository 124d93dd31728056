"""Volumes from and to the Ultrasound File Format (UFF), as beamformed data of the `pyuff_ustb` package.

Bernard et al. 2018. The package is an optional extra: `pip install torchsph[uff]`. Pixels may come in any order;
they must fill a regular grid. In a plane, UFF's z is our second axis, y. IQ is complex with one channel; a velocity
is real with one channel per component.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from geometry import Grid

from .acquisition import Acquisition, Beams, Packet
from .phase import baseband


@dataclass(frozen=True, eq=False)
class UffVolumes:
    """Volumes on a grid, as UFF's beamformed data hold them.

    Args:
        values: (T, C, *shape), complex IQ (C = 1) or real components.
        grid: where the values lie.
        frame_rate: Hz (UFF stores whole numbers); ``None`` where the file has none.
        modulation_frequency: Hz; ``None`` where the file has none.
    """

    values: np.ndarray
    grid: Grid
    frame_rate: float | None = None
    modulation_frequency: float | None = None

    def packet(self, beams: Beams, *, sound_speed: float = 1540.0, noise: float | None = None) -> Packet:
        """The volumes as a packet to track, in baseband whichever convention the file's IQ has.

        Args:
            beams: along which the samples were taken; UFF's beamformed data do not say.
            sound_speed: m/s.
            noise: power of the thermal noise per sample, if known.

        Raises:
            ValueError: where they are no IQ, lack their rates, or their phase fits no convention.
        """
        if not np.iscomplexobj(self.values) or self.values.shape[1] != 1:
            raise ValueError("these UFF volumes are no IQ: they must be complex with one channel")
        if self.frame_rate is None or self.modulation_frequency is None:
            raise ValueError("the UFF file states no frame_rate or no modulation_frequency; set them in UffVolumes")
        acquisition = Acquisition(self.modulation_frequency, sound_speed, self.frame_rate, len(self.values))
        iq = torch.from_numpy(np.ascontiguousarray(self.values[:, 0]))
        return baseband(Packet(iq, self.grid, acquisition, beams, noise))


def read_uff(path: str | Path, name: str = "beamformed_data") -> UffVolumes:
    """Read beamformed data of a UFF file.

    Args:
        path: of the file.
        name: of the object in it.

    Raises:
        FileNotFoundError: where there is no such file.
        ImportError: without pyuff_ustb.
        ValueError: where the data are missing or their pixels do not fill a regular grid.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"no UFF file at {path}")
    pyuff = _pyuff()
    try:
        found = pyuff.Uff(str(path)).read(name)
    except (KeyError, OSError, NotImplementedError) as error:
        raise ValueError(f"{path}: no readable UFF object {name!r} ({error})") from error
    if not isinstance(found, pyuff.BeamformedData) or found.data is None:
        raise ValueError(f"{path}: {name!r} is not beamformed data with pixels")
    pixels = np.asarray(found.scan.xyz, np.float64)
    grid, order = regular_grid(pixels, f"{path}: {name!r}")
    data = np.asarray(found.data)
    pixels_channels_waves_frames = data.shape + (1,) * (4 - data.ndim)
    _, channels, waves, images = pixels_channels_waves_frames
    if waves != 1:
        raise ValueError(f"{path}: {name!r} holds {waves} waves; compound them first")
    values = data.reshape(pixels_channels_waves_frames)[order][:, :, 0].transpose(2, 1, 0)
    values = values.reshape(images, channels, *grid.shape)
    return UffVolumes(values, grid, _number(found.frame_rate), _number(found.modulation_frequency))


def write_uff(path: str | Path, volumes: UffVolumes, name: str = "beamformed_data") -> None:
    """Write beamformed data into a UFF file, replacing what has their name.

    Args:
        path: of the file, which is made if there is none.
        volumes: what to write.
        name: of the object in the file.

    Raises:
        ImportError: without pyuff_ustb.
        ValueError: for a frame rate that is no whole number of Hz.
    """
    pyuff = _pyuff()
    rate = volumes.frame_rate
    if rate is not None and rate != round(rate):
        raise ValueError(f"UFF holds whole frame rates only, not {rate} Hz")
    nodes = volumes.grid.nodes().numpy()
    if volumes.grid.dimension == 2:
        nodes = np.stack([nodes[:, 0], np.zeros(len(nodes)), nodes[:, 1]], 1)
    scan = pyuff.Scan(x=nodes[:, 0], y=nodes[:, 1], z=nodes[:, 2])
    images, channels = volumes.values.shape[:2]
    data = volumes.values.reshape(images, channels, -1).transpose(2, 1, 0)[:, :, None]
    optional = {
        "frame_rate": None if rate is None else int(rate),
        "modulation_frequency": volumes.modulation_frequency,
    }
    extra = {key: value for key, value in optional.items() if value is not None}
    pyuff.BeamformedData(data=data, scan=scan, **extra).write(str(path), name, overwrite=True)


def regular_grid(pixels: np.ndarray, source: str) -> tuple[Grid, np.ndarray]:
    """The grid that pixels fill in any order, and the order (n,) that sorts them as its array is.

    A constant y makes a plane, and z its second axis.

    Args:
        pixels: (n, 3), m.
        source: what the error calls them.

    Raises:
        ValueError: where nodes are missing, doubled or uneven.
    """
    flat = np.ptp(pixels[:, 1]) < 1e-9
    columns = pixels[:, [0, 2]] if flat else pixels
    origin, spacing, counts, index = [], [], [], []
    for column in columns.T:
        low, span = column.min(), np.ptp(column)
        distinct = np.unique(np.round((column - low) / 1e-9).astype(np.int64))
        count = len(np.flatnonzero(np.diff(distinct) > 10)) + 1  # nodes closer than 10 nm are the same
        step = span / (count - 1) if count > 1 else 1e-3
        origin.append(low)
        spacing.append(step)
        counts.append(count)
        place = (column - low) / step
        if np.abs(place - place.round()).max() > 0.01:
            raise ValueError(f"{source}: the pixels are not evenly spaced; resample them to a regular grid")
        index.append(place.round().astype(np.int64))
    number = np.ravel_multi_index(index[::-1], counts[::-1])
    order = np.argsort(number)
    if len(number) != np.prod(counts) or not np.array_equal(number[order], np.arange(len(number))):
        raise ValueError(f"{source}: {len(number)} pixels do not fill a regular grid of {tuple(counts)}")
    return Grid(tuple(origin), tuple(spacing), tuple(counts[::-1])), order


def _pyuff() -> ModuleType:
    try:
        import pyuff_ustb
    except ImportError as error:
        raise ImportError("UFF files need the optional package pyuff_ustb: pip install torchsph[uff]") from error
    return pyuff_ustb


def _number(value: object) -> float | None:
    return None if value is None else float(np.asarray(value).reshape(-1)[0])
