"""The signals that the elements of an array receive, and how MATLAB files hold them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..acquisition import Acquisition


@dataclass(frozen=True, eq=False)
class ChannelData:
    """What the elements of an array receive of T transmissions of one wave.

    Args:
        signals: (T, samples, elements), real (RF) or complex (IQ, demodulated at the acquisition's frequency).
        elements: (elements, D), m; sound leaves them along the last axis.
        delays: (elements,), s, when each one transmits; NaN = it does not.
        sampling_rate: Hz.
        acquisition: how the images were taken.
        start: s, time of the first sample.
        bandwidth: of the pulse, as a part of its frequency; ``None`` = not known.
    """

    signals: Tensor
    elements: Tensor
    delays: Tensor
    sampling_rate: float
    acquisition: Acquisition
    start: float = 0.0
    bandwidth: float | None = None

    def __post_init__(self) -> None:
        if self.signals.dim() != 3:
            raise ValueError(f"signals must be (T, samples, elements), got the shape {tuple(self.signals.shape)}")
        count = self.signals.shape[2]
        if self.elements.dim() != 2 or len(self.elements) != count or self.elements.shape[1] not in (2, 3):
            raise ValueError(
                f"elements must be ({count}, 2 or 3) for these signals, got the shape {tuple(self.elements.shape)}"
            )
        if self.delays.shape != (count,) or not bool(torch.isfinite(self.delays).any()):
            raise ValueError(f"delays must be {count} times, at least one of them finite")
        if not (math.isfinite(self.sampling_rate) and self.sampling_rate > 0):
            raise ValueError(f"sampling_rate must be positive and finite, got {self.sampling_rate!r}")
        if self.bandwidth is not None and not 0 < self.bandwidth < 2:
            raise ValueError(f"bandwidth must be a part of the frequency between 0 and 2, got {self.bandwidth!r}")


def linear_array(count: int, pitch: float) -> Tensor:
    """Places (count, 2), m, of the elements of a linear array around 0, along x.

    Args:
        count: of elements.
        pitch: m, between them.
    """
    x = (torch.arange(count, dtype=torch.float64) - 0.5 * (count - 1)) * pitch
    return torch.stack([x, torch.zeros_like(x)], 1)


def plane_wave_delays(elements: Tensor, direction: tuple[float, ...], sound_speed: float) -> Tensor:
    """When elements transmit, (E,), s from the first one on, so that a plane wave leaves along a direction.

    Args:
        elements: (E, D), m.
        direction: (D,), of the wave.
        sound_speed: m/s.
    """
    along = elements.new_tensor(direction)
    delays = elements @ (along / along.norm()) / sound_speed
    return delays - delays.min()


def diverging_wave_delays(elements: Tensor, source: tuple[float, ...], sound_speed: float) -> Tensor:
    """When elements transmit, (E,), s from the first one on, so that a wave diverges from a source behind them.

    Args:
        elements: (E, D), m.
        source: (D,), m, the virtual source.
        sound_speed: m/s.
    """
    delays = (elements - elements.new_tensor(source)).norm(dim=1) / sound_speed
    return delays - delays.min()


def read_channel_data(path: str | Path, *, signals: str = "", parameters: str = "param") -> ChannelData:
    """Channel data of a MATLAB file (version 5 to 7) with a structure of parameters as of MUST and PyMUST.

    Args:
        path: of the file.
        signals: array (samples, elements, T); "" = `RF`, `IQ` or `SIG`, whichever there is.
        parameters: structure with `fc`, `fs`, `pitch` (or `elements`), and where they are not the default `c`, `t0`,
            `TXdelay`, `PRF` and `bandwidth` (in percent).

    Raises:
        FileNotFoundError: where there is no such file.
        ValueError: where it is no such file, or something is missing in it.
    """
    from scipy.io import loadmat

    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    try:
        content = loadmat(str(path), squeeze_me=False, struct_as_record=False)
    except Exception as fault:  # SciPy's reader has errors of many kinds
        raise ValueError(f"{path}: is no MATLAB file of version 5 to 7 ({fault}); save it with -v7") from fault
    present = [name for name in ([signals] if signals else ["RF", "IQ", "SIG"]) if name in content]
    if not present or parameters not in content:
        held = ", ".join(name for name in content if not name.startswith("__"))
        raise ValueError(
            f"{path}: needs an array of signals ({signals or 'RF, IQ or SIG'}) and a structure {parameters}; "
            f"it holds {held}"
        )
    values = np.asarray(content[present[0]])
    if values.ndim not in (2, 3) or values.dtype.kind not in "fiuc":
        raise ValueError(f"{path}: {present[0]} must be (samples, elements, T) numbers, not {values.shape}")
    values = values.reshape(*values.shape[:2], -1).transpose(2, 0, 1)
    single = values.astype(np.complex64 if values.dtype.kind == "c" else np.float32)
    return _with_parameters(torch.from_numpy(single), _structure(content[parameters]), f"{path}: {parameters}")


def _structure(found: object) -> dict[str, np.ndarray]:
    """Numeric fields of a MATLAB structure, by names in lower case."""
    one = np.asarray(found, dtype=object).reshape(-1)[0]
    names = getattr(one, "_fieldnames", [])
    fields = {name.lower(): np.asarray(getattr(one, name)) for name in names}
    return {name: value.astype(np.float64).reshape(-1) for name, value in fields.items() if value.dtype.kind in "fiu"}


def _with_parameters(signals: Tensor, said: Mapping[str, np.ndarray], source: str) -> ChannelData:
    missing = [name for name in ("fc", "fs") if name not in said]
    missing += ["pitch"] if "pitch" not in said and "elements" not in said else []
    if missing:
        raise ValueError(f"{source}: lacks {', '.join(missing)}")
    if np.isfinite(said.get("radius", np.array([np.inf]))).any():
        raise ValueError(f"{source}: describes a convex array (radius); give its places in ChannelData(elements=)")
    images, _, count = signals.shape
    if "elements" in said:
        raise ValueError(f"{source}: holds places of its own (elements); give them in ChannelData(elements=)")
    delays = said.get("txdelay", np.zeros(count))
    if len(delays) != count:
        raise ValueError(
            f"{source}: TXdelay holds {len(delays)} times for {count} elements; one wave at a time is read"
        )
    sound_speed, rate = float(said.get("c", np.array([1540.0]))[0]), float(said.get("prf", np.array([1e3]))[0])
    return ChannelData(
        signals,
        linear_array(count, float(said["pitch"][0])),
        torch.from_numpy(delays),
        float(said["fs"][0]),
        Acquisition(float(said["fc"][0]), sound_speed, rate, images),
        float(said.get("t0", np.zeros(1))[0]),
        float(said["bandwidth"][0]) / 100 if "bandwidth" in said else None,
    )
