"""Other trackers in the place of ours: the interface they meet, and a way to call one that is a C library.

Grønli 2017, sec. 3.3 calls the laboratory's tracker through ctypes with a C struct of parameters. The same
contract, spelt out (doubles in SI units, x before y before z, row-major arrays, IQ interleaved real, imaginary):

    typedef struct {
        int32_t dimension, images, nz, ny, nx;       // nz = 1 in a plane, whose second axis is y
        double spacing[3], interval, frequency, sound_speed;
        double kernel, search;                       // side of the kernel, m; greatest speed, m/s
        double beam[3];
    } speckle_parameters;

    int speckle_track(const speckle_parameters *, const float *iq,   // (images, nz, ny, nx, 2)
                      int64_t points, const double *position,        // (points, 3), m from node (0, 0, 0)
                      float *velocity, float *correlation);          // (points, 3) m/s and (points,)

It returns 0, or a code of its own that is passed on in the error. NaN velocities mean "no estimate".
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from ..acquisition import Packet
from ..phase import baseband
from .clutter import ClutterFilter
from .estimates import Estimates, Flag


class Tracker(Protocol):
    """Anything that finds velocities in a packet of IQ images."""

    def track(self, packet: Packet, points: Tensor) -> Estimates:
        """Estimates at some points.

        Args:
            packet: IQ images.
            points: (n, D), m, inside the image.
        """
        ...


class _Parameters(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int32) for name in ("dimension", "images", "nz", "ny", "nx")),
        ("spacing", ctypes.c_double * 3),
        *((name, ctypes.c_double) for name in ("interval", "frequency", "sound_speed", "kernel", "search")),
        ("beam", ctypes.c_double * 3),
    ]


@dataclass(frozen=True)
class LibraryTracker:
    """A tracker in a shared library, see the module's text. Parallel beams only.

    Args:
        path: of the library.
        kernel: m, side of the kernel, passed on.
        search: m/s, greatest speed per component, passed on.
        clutter: filter applied here first; ``None`` = the library has its own.
        min_correlation: estimates below are flagged.
    """

    path: str | Path
    kernel: float = 1e-3
    search: float = 1.0
    clutter: ClutterFilter | None = None
    min_correlation: float = 0.5

    def __post_init__(self) -> None:
        if not Path(self.path).is_file():
            raise FileNotFoundError(f"no tracking library at {self.path}")
        self._function()

    def _function(self) -> Callable[..., int]:
        try:
            function = ctypes.CDLL(str(Path(self.path).resolve())).speckle_track
        except OSError as error:
            raise ValueError(f"{self.path} is not a shared library for this machine: {error}") from error
        except AttributeError as error:
            raise ValueError(f"{self.path} does not export speckle_track") from error
        pointer = ctypes.c_void_p
        function.argtypes = [ctypes.POINTER(_Parameters), pointer, ctypes.c_int64, pointer, pointer, pointer]
        function.restype = ctypes.c_int
        return function

    def track(self, packet: Packet, points: Tensor) -> Estimates:
        """Estimates at some points; see :class:`Tracker`.

        Args:
            packet: IQ images.
            points: (n, D), m, inside the image.

        Raises:
            RuntimeError: with the library's code where it fails.
            ValueError: where the beams come from an apex.
        """
        if packet.beams.apex is not None:
            raise ValueError("the library's interface knows parallel beams only")
        packet = baseband(packet)
        iq = packet.iq if self.clutter is None else self.clutter.apply(packet.iq)
        samples = torch.view_as_real(iq.to(torch.complex64).cpu().contiguous()).contiguous()
        dimension = packet.grid.dimension
        position = torch.zeros((len(points), 3), dtype=torch.float64)
        position[:, :dimension] = points.double().cpu() - torch.tensor(packet.grid.origin, dtype=torch.float64)
        velocity, correlation = torch.full((len(points), 3), torch.nan), torch.zeros(len(points))
        code = self._function()(
            ctypes.byref(self._parameters(packet, len(iq))),
            samples.data_ptr(),
            len(points),
            position.data_ptr(),
            velocity.data_ptr(),
            correlation.data_ptr(),
        )
        if code != 0:
            raise RuntimeError(f"speckle_track of {self.path} failed with code {code}")
        return self._estimates(velocity[:, :dimension], correlation)

    def _parameters(self, packet: Packet, images: int) -> _Parameters:
        shape = (1,) * (3 - packet.grid.dimension) + packet.grid.shape
        missing = 3 - packet.grid.dimension
        triple = ctypes.c_double * 3
        return _Parameters(
            packet.grid.dimension,
            images,
            *shape,
            triple(*packet.grid.spacing, *[1.0] * missing),
            packet.acquisition.interval,
            packet.acquisition.frequency,
            packet.acquisition.sound_speed,
            self.kernel,
            self.search,
            triple(*packet.beams.direction, *[0.0] * missing),
        )

    def _estimates(self, velocity: Tensor, correlation: Tensor) -> Estimates:
        unknown = torch.full_like(correlation, torch.nan)
        missing = ~torch.isfinite(velocity).all(1)
        flags = missing.to(torch.int32) * int(Flag.NOT_FINITE)
        flags |= (correlation < self.min_correlation).to(torch.int32) * int(Flag.DECORRELATED)
        flags |= (velocity.abs() > self.search).any(1).to(torch.int32) * int(Flag.EDGE)
        clean = torch.where(missing[:, None], 0, velocity)
        return Estimates(
            velocity=clean,
            correlation=correlation,
            peak_ratio=unknown,
            curvature=torch.full_like(clean, torch.nan),
            variance=torch.full_like(clean, torch.nan),
            power=unknown,
            snr=unknown,
            response=unknown,
            shear=unknown,
            bend=unknown,
            lag=torch.ones_like(flags),
            flags=flags,
        )
