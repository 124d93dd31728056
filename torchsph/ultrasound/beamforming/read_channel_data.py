"""Channel data of MATLAB files, with the parameters that MUST and PyMUST give them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..acquisition import Acquisition
from .channel_data import ChannelData, convex_array, linear_array
from .matlab_content import Content, matlab_content

NAMES = ("RF", "IQ", "SIG")


def read_channel_data(path: str | Path, *, signals: str = "", parameters: str = "param") -> ChannelData:
    """Channel data of one wave, as `read_transmissions` reads them.

    Args:
        path: of the file.
        signals: array (samples, elements, T); "" = `RF`, `IQ` or `SIG`, whichever there is.
        parameters: name of the structure of parameters.

    Raises:
        FileNotFoundError: where there is no such file.
        ValueError: where it is no such file, something is missing in it, or it holds several waves.
    """
    waves = read_transmissions(path, signals=signals, parameters=parameters)
    if len(waves) > 1:
        raise ValueError(f"{path}: {parameters}: TXdelay describes {len(waves)} waves; use read_transmissions")
    return waves[0]


def read_transmissions(path: str | Path, *, signals: str = "", parameters: str = "param") -> tuple[ChannelData, ...]:
    """Channel data of each of the waves that make an image; `delay_and_sum` compounds them.

    MATLAB files of version 5 to 7 and of 7.3, of linear arrays, convex ones (`radius`) and places of elements of their
    own (`elements`).

    Args:
        path: of the file.
        signals: array (samples, elements, images) of one wave; of W waves (samples, elements, W, images), with the
            waves of an image one after the other along one axis (samples, elements, W times images), or a cell array
            of W; "" = `RF`, `IQ` or `SIG`, whichever there is.
        parameters: name of the structure with `fc`, `fs`, `pitch` (or `elements`), and where they are not the default
            `c`, `t0`, `TXdelay` (W, elements), `radius`, `PRF` (of the waves; images come W times as seldom) and
            `bandwidth` (in percent).

    Raises:
        FileNotFoundError: where there is no such file.
        ValueError: where it is no such file, or something is missing in it.
    """
    content = matlab_content(Path(path))
    present = [name for name in ([signals] if signals else NAMES) if name in content]
    said = content.get(parameters)
    if not present or not isinstance(said, dict):
        raise ValueError(
            f"{path}: needs an array of signals ({signals or 'RF, IQ or SIG'}) and a structure {parameters}; "
            f"it holds {', '.join(content)}"
        )
    numbers = {name.lower(): value for name, value in said.items() if isinstance(value, np.ndarray)}
    numbers = {name: value.astype(np.float64) for name, value in numbers.items() if value.dtype.kind in "fiu"}
    about = _Parameters(numbers, f"{path}: {parameters}")
    stored = _signals(content[present[0]], about, f"{path}: {present[0]}")
    return tuple(about.channel_data(one, wave) for wave, one in enumerate(stored))


@dataclass(frozen=True, eq=False)
class _Parameters:
    """The numbers of a structure, names in lower case, and what its messages open with."""

    said: Mapping[str, np.ndarray]
    source: str

    def __post_init__(self) -> None:
        missing = [name for name in ("fc", "fs") if name not in self.said]
        missing += ["pitch"] if "pitch" not in self.said and "elements" not in self.said else []
        if missing:
            raise ValueError(f"{self.source}: lacks {', '.join(missing)}")

    def number(self, name: str, otherwise: float) -> float:
        """The first number of a field."""
        value = self.said.get(name)
        return otherwise if value is None or value.size == 0 else float(value.reshape(-1)[0])

    def delays(self, count: int) -> np.ndarray:
        """(W, elements), s."""
        found = self.said.get("txdelay", np.zeros((1, count)))
        found = np.atleast_2d(found)
        if found.shape[0] == count and found.shape[1] != count:
            found = found.T
        if found.shape[1] != count:
            raise ValueError(f"{self.source}: TXdelay holds {found.shape} times for {count} elements")
        return found

    def array(self, count: int) -> tuple[Tensor, Tensor | None]:
        """Places and normals of the elements; no normals where all look along z."""
        radius = self.number("radius", np.inf)
        if "elements" in self.said:
            places = self.said["elements"].reshape(self.said["elements"].shape[0], -1)
            places = places.T if places.shape == (2, count) or places.shape == (1, count) else places
            if places.shape not in ((count, 1), (count, 2)) or np.isfinite(radius):
                raise ValueError(f"{self.source}: elements must be x, or x and z, of {count} elements, without radius")
            both = np.c_[places, np.zeros(count)] if places.shape[1] == 1 else places
            return torch.from_numpy(np.ascontiguousarray(both)), None
        pitch = self.number("pitch", np.nan)
        return convex_array(count, pitch, radius) if np.isfinite(radius) else (linear_array(count, pitch), None)

    def channel_data(self, signals: np.ndarray, wave: int) -> ChannelData:
        """The data (T, samples, elements) of a wave."""
        images, _, count = signals.shape
        delays = self.delays(count)
        elements, normals = self.array(count)
        rate = self.number("prf", 1e3) / len(delays)
        single = np.ascontiguousarray(signals, np.complex64 if signals.dtype.kind == "c" else np.float32)
        return ChannelData(
            torch.from_numpy(single),
            elements,
            torch.from_numpy(np.ascontiguousarray(delays[wave])),
            self.number("fs", np.nan),
            Acquisition(self.number("fc", np.nan), self.number("c", 1540.0), rate, images),
            self.number("t0", 0.0),
            self.number("bandwidth", np.nan) / 100 if "bandwidth" in self.said else None,
            normals,
        )


def _signals(stored: Content, about: _Parameters, source: str) -> list[np.ndarray]:
    """The signals (T, samples, elements) of each wave."""
    if isinstance(stored, list):
        parts = [part for part in stored if isinstance(part, np.ndarray)]
        if not parts or any(part.shape != parts[0].shape or part.ndim not in (2, 3) for part in parts):
            raise ValueError(f"{source}: its cells must be (samples, elements, T) numbers of one shape")
        count = len(about.delays(parts[0].shape[1]))
        if len(parts) != count:
            raise ValueError(f"{source}: has {len(parts)} cells, but TXdelay describes {count} waves")
        return [_images(part) for part in parts]
    if not isinstance(stored, np.ndarray) or stored.ndim not in (2, 3, 4) or stored.dtype.kind not in "fiuc":
        shape = stored.shape if isinstance(stored, np.ndarray) else "a structure"
        raise ValueError(f"{source}: must be (samples, elements, T) numbers, not {shape}")
    count = len(about.delays(stored.shape[1]))
    if stored.ndim == 4 and stored.shape[2] == count:
        return [_images(stored[:, :, wave]) for wave in range(count)]
    images = stored.shape[2] if stored.ndim == 3 else 1
    if stored.ndim == 4 or images % count:
        raise ValueError(f"{source}: has the shape {stored.shape}, but TXdelay describes {count} waves")
    whole = stored.reshape(*stored.shape[:2], -1)
    return [_images(whole[:, :, wave::count]) for wave in range(count)]


def _images(part: np.ndarray) -> np.ndarray:
    return part.reshape(*part.shape[:2], -1).transpose(2, 0, 1)
