"""Smoothing splines in time with their posterior: series of one sampling, each with a noise level of its own.

A series is y(t_k) = f(t_k) + noise, f a polynomial of degree below ``ORDER`` (periodic: a constant) plus a Gaussian
process whose mean given the data is the smoothing spline that penalises the square of the ORDER-th derivative
(G. Wahba, "Spline Models for Observational Data", SIAM 1990, sections 1.3, 2.1 and 5.1). Noise and process variance are
those of largest restricted likelihood (section 4.8).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

# third derivatives: the rate of an estimated volume is then as smooth as a velocity's curvature asks for
ORDER = 3
# noise over process variance, of the largest eigenvalue: from nothing to see through to nothing to see
_RATIOS = np.geomspace(1e-12, 1e6, 181)


@dataclass(frozen=True, eq=False)
class SmoothedSeries:
    """Estimates of (n,) series at the K times of their samples.

    Attributes:
        value: (K, n) estimated series.
        rate: (K, n) their derivatives in time, 1/s.
        value_variance: (K, n) posterior variance of `value`.
        rate_variance: (K, n) posterior variance of `rate`.
        noise: (n,) deviation of the samples' errors.
    """

    value: np.ndarray
    rate: np.ndarray
    value_variance: np.ndarray
    rate_variance: np.ndarray
    noise: np.ndarray


@dataclass(frozen=True, eq=False)
class SplineInTime:
    """The smoothing spline of one set of times, ready for any number of series.

    Args:
        time: (K,) s, increasing, K > ORDER + 1.
        period: s, 0 where the series do not repeat.

    Raises:
        ValueError: there are too few times to tell noise from motion.
    """

    time: np.ndarray
    period: float = 0.0

    def __post_init__(self) -> None:
        if len(self.time) < self.least_times:
            raise ValueError(f"SplineInTime needs at least {self.least_times} times, got {len(self.time)}")

    least_times = ORDER + 3

    @property
    def _length(self) -> float:
        return self.period or float(self.time[-1] - self.time[0])

    @cached_property
    def _kernels(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Covariance (K, K) at the times, its derivative in the first time, null space (K, m), its derivative."""
        at = (self.time - self.time[0]) / self._length
        make = _periodic if self.period else _integrated_wiener
        kernel, slope, null, null_slope = make(at)
        return kernel, slope / self._length, null, null_slope / self._length

    @cached_property
    def _spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues (K - m,) and vectors (K, K - m) of the covariance beside the null space."""
        kernel, _, null, _ = self._kernels
        beside = np.linalg.qr(null, mode="complete")[0][:, null.shape[1] :]
        values, vectors = np.linalg.eigh(beside.T @ kernel @ beside)
        return np.maximum(values, 0.0), beside @ vectors

    def fit(self, series: np.ndarray) -> SmoothedSeries:
        """Estimate series (K, n), each with the noise and smoothness of its own largest restricted likelihood."""
        values, vectors = self._spectrum
        seen = vectors.T @ series
        ratio, process = _most_likely(values, seen)
        slopes = self._rate_maps(ratio)
        damped = ratio / (values[:, None] + ratio)
        # what the samples say beyond the spline is noise: the rest of the identity is the posterior's shape
        spread = 1.0 - np.einsum("ki,in->kn", vectors**2, damped)
        noise = process * ratio
        value = series - vectors @ (damped * seen)
        rate = np.einsum("nkj,jn->kn", slopes, series)
        return SmoothedSeries(value, rate, noise * spread, self._rate_variance(ratio, noise), np.sqrt(noise))

    def _rate_maps(self, ratio: np.ndarray) -> np.ndarray:
        """Maps (n, K, K) from samples to derivatives of the splines of each ratio (n,)."""
        kernel, slope, null, null_slope = self._kernels
        values, vectors = self._spectrum
        inverse = np.linalg.pinv(null)
        maps = np.empty((len(ratio), len(kernel), len(kernel)))
        for number, own in enumerate(ratio):
            weights = (vectors / (values + own)) @ vectors.T
            trend = inverse @ (np.eye(len(kernel)) - (kernel + own * np.eye(len(kernel))) @ weights)
            maps[number] = slope @ weights + null_slope @ trend
        return maps

    def _rate_variance(self, ratio: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Posterior variance (K, n) of the rates: of differences over the neighbouring samples.

        A difference is the mean rate over its interval; at the samples' own spacing the spline cannot tell more.
        """
        values, vectors = self._spectrum
        difference = self._differences
        turned = difference @ vectors
        full = (difference**2).sum(1)
        taken = np.einsum("ki,in->kn", turned**2, ratio / (values[:, None] + ratio))
        return noise * np.maximum(full[:, None] - taken, 0.0)

    @cached_property
    def _differences(self) -> np.ndarray:
        """The difference (K, K) over each sample's neighbours, 1/s; one-sided at ends that do not repeat."""
        count = len(self.time)
        out = np.zeros((count, count))
        for row in range(count):
            early, late = row - 1, row + 1
            if not self.period:
                early, late = max(early, 0), min(late, count - 1)
            span = (self.time[late % count] - self.time[early]) % self.period if self.period else None
            span = self.time[late] - self.time[early] if span is None else span
            out[row, late % count] += 1.0 / span
            out[row, early] -= 1.0 / span
        return out


def _most_likely(values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ratio of noise to process and process variance (n,) of largest restricted likelihood.

    Args:
        values: (m,) eigenvalues of the covariance.
        seen: (m, n) series in its eigenvectors.
    """
    best = np.full(seen.shape[1], np.inf)
    ratio, process = np.zeros_like(best), np.zeros_like(best)
    for own in _RATIOS * values.max():
        spread = values + own
        variance = (seen**2 / spread[:, None]).mean(0)
        unlikely = len(values) * np.log(np.maximum(variance, np.finfo(float).tiny)) + np.log(spread).sum()
        better = unlikely < best
        best[better], ratio[better], process[better] = unlikely[better], own, variance[better]
    return ratio, process


def _integrated_wiener(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Covariance of the twice integrated Wiener process at times (K,) from 0 to 1, and its parts (Wahba 1.5)."""
    least, gap = np.minimum(at[:, None], at), np.abs(at[:, None] - at)
    kernel = (least**5 / 5 + gap * least**4 / 2 + gap**2 * least**3 / 3) / 4
    later = least**4 / 8 + gap * least**3 / 6
    earlier = least**4 / 8 + gap * least**3 / 3 + gap**2 * least**2 / 4
    slope = np.where(at[:, None] >= at, later, earlier)
    powers = np.arange(ORDER)
    null = at[:, None] ** powers
    null_slope = powers * at[:, None] ** np.maximum(powers - 1, 0)
    return kernel, slope, null, null_slope


def _periodic(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Covariance of the periodic spline at times (K,) of one period: Bernoulli polynomials (Wahba 2.1.4)."""
    gap = np.mod(at[:, None] - at, 1.0)
    sixth = gap**6 - 3 * gap**5 + 2.5 * gap**4 - 0.5 * gap**2 + 1 / 42
    fifth = gap**5 - 2.5 * gap**4 + 5 / 3 * gap**3 - gap / 6
    ones = np.ones((len(at), 1))
    return sixth / 720, fifth / 120, ones, np.zeros_like(ones)
