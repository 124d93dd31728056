"""How wrong a measurement is: error variance per node and component, and how many nodes share one error.

The file's ``sigma`` is believed where there is one.  Otherwise the errors are estimated from the measurement itself:
what a smooth, incompressible field cannot explain is noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import geometry

from .smooth import FrameSmoother, node_weights

_LAGS = 6
_MAD_TO_STD = 1.4826
_SURPRISING = 3.0


@dataclass(frozen=True)
class ObservationError:
    """Error model of a measurement.

    Attributes:
        deviation: (T, D) standard deviation (m/s) of a node of mean weight in each frame, or None where the file
            gives ``sigma``.
        redundancy: (T,) number of nodes that carry the same error, at least 1: their variances are multiplied by it,
            so that neighbours with a common error are not counted as independent.
        surprise: (T, *shape) factors, at least 1, on the variance of nodes that stand out from their surroundings.
    """

    deviation: np.ndarray | None
    redundancy: np.ndarray
    surprise: np.ndarray

    def variance(self, recording: geometry.Recording, frame: int) -> np.ndarray:
        """(D, *shape), m^2/s^2; infinite where nothing was measured.

        A node of weight w has the mean node's variance times (mean weight / w): the weight is a confidence.
        """
        weight = node_weights(recording, frame)
        measured = weight > 0
        if self.deviation is None:
            own = recording.sigma[frame].astype(np.float64) ** 2
            return np.where(measured, own * self.surprise[frame], np.inf)
        mean = weight[measured].mean() if measured.any() else 1.0
        factor = np.where(measured, mean / np.where(measured, weight, 1.0) * self.surprise[frame], np.inf)
        shape = (-1,) + (1,) * recording.dimension
        return self.deviation[frame].reshape(shape) ** 2 * factor


def estimate_error(
    measured: geometry.Recording, splines: FrameSmoother, smoothed: geometry.Recording
) -> ObservationError:
    """The error model of a measurement from what its splines leave over, frame by frame.

    The deviation of each component is a robust one (median absolute residual), so that outliers do not widen it. The
    redundancy makes it the white-equivalent deviation that the spline's likelihood chose (what independent errors
    would have to be to disturb the scales of the flow as much); without such a choice it is the product over the axes
    of the residual's integral scales, 1 + 2 sum_k rho_k. Nodes beyond ``_SURPRISING`` deviations count less, as the
    square of their distance (the weight of a Student distribution's far tail).

    Raises ValueError where nothing was measured at all.
    """
    residual = np.nan_to_num(measured.velocity - smoothed.velocity).astype(np.float64)
    used = np.stack([node_weights(measured, f) > 0 for f in range(measured.frames)])
    if not used.any():
        raise ValueError("the measurement has no node with a positive weight: nothing is known about the flow")
    robust = np.stack([_robust_deviation(residual[f], used[f]) for f in range(measured.frames)])
    pooled = np.nanmedian(robust, axis=0)
    robust = np.where(np.isfinite(robust), robust, pooled)
    floor = 1e-3 * float(np.sqrt(np.mean(np.square(smoothed.velocity, dtype=np.float64)))) + 1e-6
    robust = np.maximum(robust, floor)
    ones = (1,) * measured.dimension
    distance = np.sqrt(np.mean((residual / robust.reshape(*robust.shape, *ones)) ** 2, axis=1))
    surprise = np.maximum(distance / _SURPRISING, 1.0) ** 2
    redundancy = np.ones(measured.frames)
    for frame in range(measured.frames):
        choice = splines.choice(frame)
        if choice is not None:
            redundancy[frame] = np.mean((np.array(choice.noise) / robust[frame]) ** 2)
        else:
            scales = [_integral_scale(residual[frame], used[frame], k) for k in range(1, residual.ndim - 1)]
            redundancy[frame] = np.prod(scales)
    deviation = None if measured.sigma is not None else robust
    return ObservationError(deviation, np.maximum(redundancy, 1.0), surprise)


def _robust_deviation(residual: np.ndarray, used: np.ndarray) -> np.ndarray:
    """(D,) deviation of a frame's residual (D, *shape) at the used nodes; NaN where there are none."""
    if not used.any():
        return np.full(len(residual), np.nan)
    return _MAD_TO_STD * np.array([np.median(np.abs(part[used])) for part in residual])


def _integral_scale(residual: np.ndarray, used: np.ndarray, axis: int) -> float:
    """1 + 2 sum of the autocorrelation of a frame's residual (D, *shape) along one axis, up to its first zero."""
    whole = np.where(used, residual, 0.0)
    power = float(np.mean(whole[:, used] ** 2)) if used.any() else 0.0
    total = 1.0
    for lag in range(1, min(_LAGS, residual.shape[axis] - 1) + 1):
        early, late = np.arange(residual.shape[axis] - lag), np.arange(lag, residual.shape[axis])
        both = np.take(used, early, axis - 1) & np.take(used, late, axis - 1)
        if not both.any() or power == 0:
            break
        product = (np.take(whole, early, axis) * np.take(whole, late, axis))[:, both]
        correlation = float(np.mean(product)) / power
        if correlation <= 0:
            break
        total += 2.0 * correlation
    return total
