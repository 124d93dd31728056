"""How wrong a measurement is: error variance per node and component, and how many nodes share one error.

The file's ``sigma`` is believed where there is one.  Otherwise the errors are estimated from the measurement itself:
what a smooth, incompressible field cannot explain is noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import geometry
import regularize

from .smooth import node_weights

_LAGS = 6
_MAD_TO_STD = 1.4826


@dataclass(frozen=True)
class ObservationError:
    """Error model of a measurement.

    Attributes:
        deviation: (D,) standard deviation (m/s) of a node of mean weight, or None where the file gives ``sigma``.
        redundancy: number of nodes that carry the same error, at least 1: their variances are multiplied by it, so
            that neighbours with a common error are not counted as independent.
    """

    deviation: np.ndarray | None
    redundancy: float

    def variance(self, recording: geometry.Recording, frame: int) -> np.ndarray:
        """(D, *shape), m^2/s^2; infinite where nothing was measured.

        A node of weight w has the mean node's variance times (mean weight / w): the weight is a confidence.
        """
        weight = node_weights(recording, frame)
        measured = weight > 0
        if self.deviation is None:
            return np.where(measured, recording.sigma[frame].astype(np.float64) ** 2, np.inf)
        mean = weight[measured].mean() if measured.any() else 1.0
        factor = np.where(measured, mean / np.where(measured, weight, 1.0), np.inf)
        shape = (-1,) + (1,) * (recording.dimension)
        return self.deviation.reshape(shape) ** 2 * factor


def estimate_error(
    measured: geometry.Recording, smoothed: geometry.Recording, choice: regularize.Choice | None = None
) -> ObservationError:
    """The error model of a measurement from what its smoothed version leaves over.

    The deviation of each component is a robust one (median absolute residual), so that outliers do not widen it. The
    redundancy makes the deviation the white-equivalent one that the spline's likelihood chose (``choice.noise``: what
    independent errors would have to be to disturb the scales of the flow as much); without a choice it is the product
    over the axes of the residual's integral scales, 1 + 2 sum_k rho_k.
    """
    residual = np.nan_to_num(measured.velocity - smoothed.velocity)
    used = np.stack([node_weights(measured, f) > 0 for f in range(measured.frames)])
    if not used.any():
        raise ValueError("the measurement has no node with a positive weight: nothing is known about the flow")
    if measured.sigma is not None:
        sigma = np.moveaxis(measured.sigma, 1, -1)[used].astype(np.float64)
        deviation = np.sqrt(np.mean(sigma**2, axis=0))
    else:
        parts = [np.median(np.abs(residual[:, c][used])) for c in range(measured.dimension)]
        floor = 1e-3 * float(np.sqrt(np.mean(np.nan_to_num(measured.velocity[:, 0])[used] ** 2)) + 1e-9)
        deviation = np.maximum(_MAD_TO_STD * np.array(parts), floor)
    if choice is not None:
        redundancy = float(np.mean((np.array(choice.noise) / deviation) ** 2))
    else:
        redundancy = float(
            np.prod([_integral_scale(residual, used, residual.ndim - 1 - k) for k in range(measured.dimension)])
        )
    return ObservationError(None if measured.sigma is not None else deviation, max(redundancy, 1.0))


def _integral_scale(residual: np.ndarray, used: np.ndarray, axis: int) -> float:
    """1 + 2 sum of the residual's autocorrelation along one axis, up to its first zero."""
    total, lags = 1.0, min(_LAGS, residual.shape[axis] - 1)
    whole = np.where(used[:, None], residual, 0.0)
    power = np.mean(whole.transpose(0, *range(2, whole.ndim), 1)[used] ** 2)
    for lag in range(1, lags + 1):
        early = np.take(whole, range(whole.shape[axis] - lag), axis)
        late = np.take(whole, range(lag, whole.shape[axis]), axis)
        both = np.take(used, range(used.shape[axis - 1] - lag), axis - 1)
        both = both & np.take(used, range(lag, used.shape[axis - 1]), axis - 1)
        if not both.any() or power == 0:
            break
        product = (early * late).transpose(0, *range(2, whole.ndim), 1)[both]
        correlation = float(np.mean(product)) / power
        if correlation <= 0:
            break
        total += 2.0 * correlation
    return total
