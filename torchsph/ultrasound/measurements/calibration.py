"""How far to trust an estimate: standard deviations and weights fitted to what a tracker says of itself.

The fit sees errors of simulations made for it alone, with their own seeds and flows; it is then used on
others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from ..estimation.estimates import Estimates

RIDGE = 1e-2  # pulls coefficients that the data leave open to zero, in units of one observation
GROUPS = 8  # of training errors, by predicted deviation
LEAST_VARIANCE = 1e-8  # (m/s)^2: 0.1 mm/s; below it the squares of errors would be round-off


@dataclass(frozen=True)
class VarianceModel:
    """log variance as a rising function of a score, which is features . coefficients.

    Linear between the knots; beyond them constant, at what the fit has seen.

    Args:
        coefficients: (K,), one for each feature.
        knots: pairs of a score and a log variance, rising.
    """

    coefficients: tuple[float, ...]
    knots: tuple[tuple[float, float], ...]

    def variance(self, table: Tensor) -> Tensor:
        """Variance (n,), (m/s)^2.

        Args:
            table: (n, K), features.
        """
        score = table @ table.new_tensor(self.coefficients)
        log_variance = torch.full_like(score, self.knots[0][1])
        for (low, start), (high, end) in pairwise(self.knots):
            share = ((score - low) / (high - low)).clamp(0, 1)
            log_variance = log_variance + share * (end - start)
        return log_variance.exp()


@dataclass(frozen=True)
class Calibration:
    """How precise the estimates of a tracker are, from what it says of them.

    Args:
        lateral: variance of a component across the beam.
        axial: variance of the component along it.
        reference: m/s, total deviation at which the weight is 1/2.
    """

    lateral: VarianceModel
    axial: VarianceModel
    reference: float

    def sigma(self, estimates: Estimates, beam: Tensor) -> Tensor:
        """Standard deviation (n, D), m/s, of the estimates; ``beam`` (n, D) unit vectors."""
        lateral = self.lateral.variance(features(estimates, beam, False))
        axial = self.axial.variance(features(estimates, beam, True))
        along = beam.square()
        return (lateral[:, None] * (1 - along) + axial[:, None] * along).sqrt()

    def weight(self, estimates: Estimates, beam: Tensor) -> Tensor:
        """Confidence (n,) in [0, 1], falling with the fitted deviation; 0 where an estimate is flagged."""
        total = self.sigma(estimates, beam).square().sum(1)
        return torch.where(estimates.accepted, 1 / (1 + total / self.reference**2), 0)


def features(estimates: Estimates, beam: Tensor, axial: bool) -> Tensor:
    """What the log variance is linear in, (n, 9).

    1, predicted log variance, log(1 - rho), log peak ratio, log shear, log bend, and in 10 dB the SNR, the share of
    power passed by the clutter filter and its response to the velocity. All bounded, so that an odd estimate cannot
    ask for an absurd deviation. What a tracker does not tell (NaN) counts as the least that is known: a variance of
    1 m^2/s^2, a peak ratio of 1, an SNR of 20 dB.

    Args:
        estimates: of n points.
        beam: (n, D), unit vectors along the beams.
        axial: whether of the component along the beam or of those across it.
    """
    along = beam.square()
    share = along if axial else (1 - along) / max(beam.shape[1] - 1, 1)
    predicted = torch.nan_to_num((estimates.variance * share).sum(1), nan=1.0).clamp(1e-10, 1.0).log()
    decorrelation = (1 - estimates.correlation).clamp(1e-4, 1.0).log()
    ratio = torch.nan_to_num(estimates.peak_ratio, nan=1.0).clamp(1.0, 10.0).log()
    snr = torch.nan_to_num(estimates.snr, nan=20.0).clamp(-10, 40) / 10
    power = torch.nan_to_num(estimates.power, nan=0.0).clamp(-60, 5) / 10
    response = torch.nan_to_num(estimates.response, nan=0.0).clamp(-20, 0) / 10
    shear = torch.nan_to_num(estimates.shear, nan=10.0).clamp(10.0, 300.0).log()
    bend = torch.nan_to_num(estimates.bend, nan=0.1).clamp(1e-3, 0.1).log()
    constant = torch.ones_like(predicted)
    return torch.stack([constant, predicted, decorrelation, ratio, shear, bend, snr, power, response], 1)


def fit_calibration(estimates: Estimates, error: Tensor, beam: Tensor) -> Calibration:
    """Fit variances to the errors of accepted estimates.

    The variance of each class is exp(features . c), with c where the Gaussian likelihood of the errors is
    highest. Its first equation is mean(error^2 / variance) = 1: outliers count in full, so the z-scores
    have unit variance.

    Args:
        estimates: of n points.
        error: (n, D), m/s, of their velocities.
        beam: (n, D), unit vectors along the beams.

    Raises:
        ValueError: where fewer than 50 estimates are accepted.
        ArithmeticError: where the fit does not converge.
    """
    kept = estimates.accepted
    if int(kept.sum()) < 50:
        raise ValueError(f"calibration needs 50 accepted estimates or more, got {int(kept.sum())}")
    along = beam.square()
    parts = []
    for axial in (False, True):
        share = along if axial else (1 - along) / max(beam.shape[1] - 1, 1)
        square = (error.square() * share).sum(1).clamp_min(LEAST_VARIANCE)
        table = features(estimates, beam, axial)[kept].double().cpu().numpy()
        seen = square[kept].double().cpu().numpy()
        coefficients = _fit_log_variance(table, seen)
        parts.append(VarianceModel(tuple(coefficients.tolist()), _rising_knots(table @ coefficients, seen)))
    model = Calibration(parts[0], parts[1], 1.0)
    total = model.sigma(estimates, beam)[kept].square().sum(1).median().sqrt()
    return Calibration(model.lateral, model.axial, float(total))


def _fit_log_variance(table: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Coefficients minimising sum(log v + square / v), v = exp(table c): Newton's method, always convex."""
    centre, scale = table.mean(0), table.std(0)
    centre[0], scale[0] = 0.0, 1.0
    scale[scale < 1e-9] = 1.0  # a feature that never varies gets no coefficient, by the ridge
    design = (table - centre) / scale
    design[:, 1:] *= table.std(0)[1:] >= 1e-9
    ridge = RIDGE * np.eye(table.shape[1])
    ridge[0, 0] = 0.0
    coefficients = np.zeros(table.shape[1])
    coefficients[0] = math.log(square.mean())
    for _ in range(100):
        ratio = square * np.exp(-design @ coefficients)
        gradient = design.T @ (1 - ratio) + ridge @ coefficients
        hessian = (design * ratio[:, None]).T @ design + ridge
        step = np.linalg.solve(hessian, gradient)
        step *= min(1.0, 1.0 / max(np.abs(design @ step).max(), 1e-12))  # at most a factor e of variance at a time
        coefficients -= step
        if np.abs(step).max() < 1e-8:
            result = coefficients / scale
            result[0] -= (coefficients[1:] * centre[1:] / scale[1:]).sum()
            return result
    raise ArithmeticError("the calibration did not converge; use more or other simulations")


def _rising_knots(score: np.ndarray, square: np.ndarray) -> tuple[tuple[float, float], ...]:
    """Mean score and log mean square of ``GROUPS`` groups by score, neighbours that fall being pooled."""
    pools: list[list[float]] = []  # score, mean square, members
    for group in np.array_split(np.argsort(score), GROUPS):
        if len(group) == 0:
            continue
        pools.append([float(score[group].mean()), float(square[group].mean()), len(group)])
        while len(pools) > 1 and (pools[-1][1] <= pools[-2][1] or pools[-1][0] <= pools[-2][0]):
            last, before = pools.pop(), pools.pop()
            members = last[2] + before[2]
            pools.append(
                [
                    *((a * last[2] + b * before[2]) / members for a, b in zip(last[:2], before[:2], strict=True)),
                    members,
                ]
            )
    return tuple((place, math.log(max(level, LEAST_VARIANCE))) for place, level, _ in pools)
