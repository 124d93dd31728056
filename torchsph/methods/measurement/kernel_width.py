"""How wide the kernel is that averaged a measurement, from how far its errors are correlated.

White noise averaged by a Gaussian of deviation s has the autocorrelation exp(-r^2 / (4 s^2)), so that differences of
the errors over two lags tell s (``kernel_width``). The errors themselves are not known, only what splines leave over of
the measurement, and splines take the errors' long waves along: what is left looks as if it came from a narrower kernel.
So noise of known kernels is sent through the same splines, and the kernel is the one whose residual looks like the
measurement's (``behind_splines``; indirect inference: Gourieroux, Monfort & Renault 1993).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.optimize import brentq

from geometry.grids.fields import fwhm_to_deviation, smooth_noise
from torchsph.assimilation.diagnostics.scores import CHI2_MEDIAN

from .frame_splines import FrameSmoother, node_weights

# the lags in nodes whose differences tell the kernel's width: short enough for what is left of the flow to be smooth
_NEAR, _FAR = 1, 3
# widths that lags of whole nodes can tell apart, in node spacings
_NARROWEST, _WIDEST = 1.2, 5.0
FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))
# kernels whose noise is sent through the splines, in widths of the residual's; and the frames in which it is
_TRIED = (1.0, 1.15, 1.3, 1.45)
_FRAMES = 2


def kernel_width(residual: np.ndarray, used: np.ndarray, spacing: tuple[float, ...]) -> float:
    """Full width at half maximum (m) of the kernel that coloured the noise; 0 where neighbours share none of it.

    From the differences of the noise, residual (T, C, *shape), over ``_NEAR`` and ``_FAR`` nodes along each axis,
    whose squares have the means 2 s^2 (1 - rho(r)): their ratio tells the width, whatever the deviation s is. The
    median over the nodes stands for the mean, because the deviation of tracking noise varies from place to place, and
    the median over axes and components is taken.
    """
    widths = []
    for axis, step in enumerate(reversed(spacing), start=1):
        if residual.shape[axis + 1] <= _FAR:
            continue
        for part in np.moveaxis(residual, 1, 0):
            near, far = (_median_square(part, used, axis, lag) for lag in (_NEAR, _FAR))
            if far > 0:
                widths.append(step * _width_of(near / far))
    width = float(np.median(widths)) if widths else 0.0
    return width if width > _NARROWEST * min(spacing) else 0.0


def _median_square(part: np.ndarray, used: np.ndarray, axis: int, lag: int) -> float:
    """Mean square of the differences over ``lag`` nodes, from their median as if they were Gaussian."""
    early, late = np.arange(part.shape[axis] - lag), np.arange(lag, part.shape[axis])
    both = np.take(used, early, axis) & np.take(used, late, axis)
    steps = (np.take(part, late, axis) - np.take(part, early, axis))[both]
    return float(np.median(np.abs(steps)) ** 2 / CHI2_MEDIAN) if len(steps) else 0.0


def _width_of(ratio: float) -> float:
    """Width in nodes at which the squares of the differences have this ratio, within what lags can tell."""

    def excess(width: float) -> float:
        return _rise(_NEAR, width) / _rise(_FAR, width) - ratio

    if excess(_NARROWEST) <= 0:
        return 0.0
    return _WIDEST if excess(_WIDEST) >= 0 else brentq(excess, _NARROWEST, _WIDEST)


def _rise(lag: float, width: float) -> float:
    """1 - rho(lag) of noise from a kernel of full width ``width`` at half maximum, in nodes."""
    return -math.expm1(-((lag * FWHM / width) ** 2) / 4.0)


def behind_splines(width: float, splines: FrameSmoother, deviation: np.ndarray) -> float:
    """The kernel (m) of noise whose residuals from the splines show the kernel ``width`` (m).

    Args:
        width: of the residuals (``kernel_width``).
        splines: the fits, which have chosen noise and smoothness.
        deviation: (T, D), m/s, of the residuals in each frame.
    """
    recording, generator = splines.recording, torch.Generator().manual_seed(0)
    spacing, tried = tuple(recording.grid.spacing), width * np.array(_TRIED)
    measuring = [frame for frame in range(recording.frames) if splines.measures(frame)]
    shown = []
    for number in range(_FRAMES):
        frame = measuring[(2 * number + 1) * len(measuring) // (2 * _FRAMES)]
        weight = torch.from_numpy(node_weights(recording, frame).astype(np.float64)).flatten()
        used, size = weight > 0, torch.from_numpy(deviation[frame]).reshape(-1, *[1] * recording.dimension)
        noise = torch.stack([size * _noise(splines, kernel, generator) for kernel in tried])
        samples = noise.flatten(2)[:, :, used].transpose(1, 2)
        fitted = splines.fit_increments(frame, splines.nodes[used], samples, weight[used], choice=splines.choice(frame))
        here = used.reshape(recording.grid.shape).numpy()[None]
        left = [one.numpy() - splines.on_grid(fit, frame) for one, fit in zip(noise, fitted, strict=True)]
        shown.append([kernel_width(one[None], here, spacing) for one in left])
    slope, start = np.polyfit(tried, np.mean(shown, axis=0), 1)
    if not slope > 0:
        return width
    return float(np.clip((width - start) / slope, width, tried[-1]))


def _noise(splines: FrameSmoother, kernel: float, generator: torch.Generator) -> torch.Tensor:
    """(D, *shape) noise of deviation 1 from a kernel, m."""
    grid = splines.recording.grid
    spacing = tuple(grid.spacing)
    return smooth_noise(grid.dimension, grid.shape, fwhm_to_deviation(kernel), spacing, generator, dtype=torch.float64)
