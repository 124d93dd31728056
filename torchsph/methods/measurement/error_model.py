"""How wrong a measurement is: error variance per node and component, and how far neighbours share one error.

The file's ``sigma`` is believed where there is one.  Otherwise the errors are estimated from the measurement itself:
what a smooth, incompressible field cannot explain is noise.

A tracking kernel averages noise and flow alike, so the length over which the errors are correlated tells how far the
measurement is blurred (``ObservationError.kernel``; ``kernel_width.py``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

import geometry
from geometry.arguments import checked

from .frame_splines import FrameSmoother, node_weights
from .kernel_width import FWHM, behind_splines, kernel_width

_MAD_TO_STD = 1.4826
_SURPRISING = 3.0
_LITTLE = 0.05  # of the speed: noise that is too little to show its own kernel
_ABOVE = 1.5  # times the stated deviation: more is no noise
_MOST_TRUST = 2.0
_AROUND = 2.0  # nodes, deviation of the Gaussian that averages the residuals' level


@dataclass(frozen=True)
class ObservationError:
    """Error model of a measurement.

    Attributes:
        deviation: (T, D) standard deviation (m/s) of a node of mean weight in each frame, or None where the file
            gives ``sigma``.
        redundancy: (T,) number of nodes that carry the same error, at least 1: their variances are multiplied by it,
            so that neighbours with a common error are not counted as independent.
        surprise: (T, *shape) factors on the variance: more where the residuals around a node are larger than usual (in
            shear, say), and for nodes that stand out from their surroundings.
        kernel: full width at half maximum (m) of the Gaussian that averaged the flow and coloured the noise; 0: none.
        trust: the variance goes with weight ** -trust, as the residuals show; 0 for weights that say nothing.
    """

    deviation: np.ndarray | None
    redundancy: np.ndarray
    surprise: np.ndarray
    kernel: float = 0.0
    trust: float = 1.0

    def variance(self, recording: geometry.Recording, frame: int) -> np.ndarray:
        """(D, *shape), m^2/s^2; infinite where nothing was measured.

        A node of weight w has the mean node's variance times (mean weight / w) ** trust.
        """
        weight = node_weights(recording, frame)
        measured = weight > 0
        if self.deviation is None:
            if recording.sigma is None:
                raise ValueError("an error model without deviations needs a recording with /sigma")
            own = recording.sigma[frame].astype(np.float64) ** 2
            return np.where(measured, own * self.surprise[frame], np.inf)
        mean = weight[measured].mean() if measured.any() else 1.0
        relative = (mean / np.where(measured, weight, 1.0)) ** self.trust
        factor = np.where(measured, relative * self.surprise[frame], np.inf)
        shape = (-1,) + (1,) * recording.dimension
        return self.deviation[frame].reshape(shape) ** 2 * factor


@checked
def estimate_error(
    measured: geometry.Recording, splines: FrameSmoother, smoothed: geometry.Recording
) -> ObservationError:
    """The error model of a measurement from what its splines leave over, frame by frame.

    The deviation of each component is a robust one (median absolute residual), so that outliers do not widen it. The
    redundancy makes it the white-equivalent deviation: what independent errors would have to be to disturb long waves
    as much, the larger of what the spline's likelihood chose and of the kernel's volume in nodes. Nodes beyond
    ``_SURPRISING`` deviations count less, as the square of their distance (the weight of a Student distribution's far
    tail). Where components alone were measured, all of it is about them.

    Raises:
        ValueError: nothing was measured at all.
    """
    residual = np.nan_to_num(measured.velocity - smoothed.velocity).astype(np.float64)
    used = np.stack([node_weights(measured, f) > 0 for f in range(measured.frames)])
    if not used.any():
        raise ValueError("the measurement has no node with a positive weight: nothing is known about the flow")
    kind = geometry.measurement_type(measured)
    residual = kind.components(residual)  # what the instrument does not see is no error
    parts, ones = residual.shape[1], (1,) * measured.dimension
    robust = np.stack([_robust_deviation(residual[f], used[f]) for f in range(measured.frames)])
    robust = np.where(np.isfinite(robust), robust, np.nanmedian(robust, axis=0))
    speed = float(np.sqrt(np.mean(np.square(smoothed.velocity, dtype=np.float64))))
    robust = np.maximum(robust, 1e-3 * speed + 1e-6)
    distance = np.sqrt(np.mean((residual / robust.reshape(-1, parts, *ones)) ** 2, axis=1))
    surprise = np.maximum(distance / _SURPRISING, 1.0) ** 2
    sigma = measured.sigma
    told = sigma is not None
    if not told:
        surprise *= np.stack([_local_level(distance[f], used[f]) for f in range(measured.frames)])
    left = float(np.median(robust))
    stated = math.inf
    if sigma is not None:
        stated = float(np.median(sigma[np.repeat(used[:, None], measured.dimension, 1)]))
    # residuals that are next to nothing, or far above the noise that the file states, are the spline's, not noise; so
    # is much of what one component's spline leaves, which the file's own deviation makes needless
    noisy = _LITTLE * speed < left < _ABOVE * stated and (kind.full or not told)
    kernel = kernel_width(residual, used, measured.grid.spacing) if noisy else 0.0
    if kernel > 0 and kind.full:
        kernel = behind_splines(kernel, splines, robust)
    redundancy = np.full(measured.frames, _nodes_of(kernel, measured.grid.spacing))
    for frame in range(measured.frames):
        choice = splines.choice(frame) if kind.full else None
        if choice is not None:
            chosen = float(np.mean((np.array(choice.noise) / robust[frame]) ** 2))
            redundancy[frame] = max(redundancy[frame], chosen)
    trust = 0.0 if told or measured.weight is None else _trust(measured, residual / robust.reshape(-1, parts, *ones))
    if parts not in (1, measured.dimension):  # components of the instrument's own: the vector's share their mean
        robust = np.sqrt(np.mean(robust**2, axis=1, keepdims=True))
    deviation = None if told else np.broadcast_to(robust, (len(robust), measured.dimension)).copy()
    return ObservationError(deviation, np.maximum(redundancy, 1.0), surprise, kernel, trust)


def _local_level(distance: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Mean square around each node (*shape) of the residuals in robust deviations, outliers cut at ``_SURPRISING``."""
    share = gaussian_filter(used.astype(np.float64), _AROUND)
    power = gaussian_filter(np.where(used, np.minimum(distance, _SURPRISING) ** 2, 0.0), _AROUND)
    return np.where(used, power / np.maximum(share, 1e-6), 1.0)


def _nodes_of(kernel: float, spacing: tuple[float, ...]) -> float:
    """The volume of the errors' autocorrelation in nodes: the integral of exp(-r^2 / (4 s^2)) over one node's."""
    reach = math.sqrt(4.0 * math.pi) * kernel / FWHM
    return math.prod(max(reach / step, 1.0) for step in spacing)


def _trust(measured: geometry.Recording, scaled: np.ndarray) -> float:
    """The power of the weight that the variance follows: a line through median log residuals against log weights."""
    weight = np.stack([node_weights(measured, f) for f in range(measured.frames)]).astype(np.float64)
    used = weight > 0
    size = np.sqrt(np.mean(scaled**2, axis=1))[used]
    known, size = weight[used][size > 0], size[size > 0]
    edges = np.unique(np.quantile(known, np.linspace(0, 1, 9)))
    if len(edges) < 4:
        return 0.0
    group = np.clip(np.searchsorted(edges, known, side="right") - 1, 0, len(edges) - 2)
    place = np.array([np.log(np.median(known[group == g])) for g in range(len(edges) - 1)])
    level = np.array([2.0 * np.log(np.median(size[group == g])) for g in range(len(edges) - 1)])
    return float(np.clip(-np.polyfit(place, level, 1)[0], -_MOST_TRUST, _MOST_TRUST))


def _robust_deviation(residual: np.ndarray, used: np.ndarray) -> np.ndarray:
    """(C,) deviation of a frame's residual (C, *shape) at the used nodes; NaN where there are none."""
    if not used.any():
        return np.full(len(residual), np.nan)
    return _MAD_TO_STD * np.array([np.median(np.abs(part[used])) for part in residual])
