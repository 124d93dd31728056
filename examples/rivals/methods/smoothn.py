"""Penalised least squares by cosine transforms, weighted and robust (Garcia 2010, Comput. Stat. Data Anal. 54, 1167).

The smoothing of PyMUST's `smoothn`: (I + s Lambda^2)^-1 in the domain of the discrete cosine transform, missing data
filled by iterations, bisquare weights from studentised residuals, s by generalised cross-validation unless it is given.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import dctn, idctn
from scipy.optimize import minimize_scalar

import geometry

from ..frames import confidence


def fit(
    recording: geometry.Recording, *, strength: float | None = None, power: float = 2.0, rounds: int = 3
) -> np.ndarray:
    """Frame by frame; ``strength`` s, None: by cross-validation; ``rounds`` of robust reweighting."""
    weights = confidence(recording) ** power
    field = np.nan_to_num(recording.velocity).astype(np.float64)
    out = [_smooth(values, weight, strength, rounds) for values, weight in zip(field, weights, strict=True)]
    return (np.stack(out) * np.asarray(recording.mask, bool)[:, None]).astype(np.float32)


def _smooth(field: np.ndarray, weight: np.ndarray, strength: float | None, rounds: int) -> np.ndarray:
    """One frame (D, *shape) with weights (*shape)."""
    axes = tuple(range(1, field.ndim))
    eigen = sum(
        (2 - 2 * np.cos(np.pi * np.arange(n) / n)).reshape([-1 if axis == k else 1 for axis in range(len(axes))])
        for k, n in enumerate(field.shape[1:])
    )
    weight = weight / max(weight.max(), 1e-12)
    known, robust, value = weight > 0, np.ones_like(weight), np.zeros_like(field)
    for _ in range(rounds):
        total = weight * robust
        found = strength
        for step in range(60):
            before = value
            spectrum = dctn(total * (field - value) + value, axes=axes, norm="ortho")
            if strength is None and step % 10 == 0:
                found = _by_cross_validation(spectrum, eigen, field, total, known)
            value = idctn(spectrum / (1 + (found or 0.0) * eigen**2), axes=axes, norm="ortho")
            if np.linalg.norm(value - before) < 1e-4 * np.linalg.norm(value):
                break
        robust = _bisquare(np.linalg.norm(field - value, axis=0), known, float(found or 0.0), field.ndim - 1)
    return value


def _by_cross_validation(
    spectrum: np.ndarray, eigen: np.ndarray, field: np.ndarray, weight: np.ndarray, known: np.ndarray
) -> float:
    """The s of the lowest GCV score (Garcia 2010, eq. 15)."""
    axes = tuple(range(1, field.ndim))

    def score(exponent: float) -> float:
        gamma = 1 / (1 + 10**exponent * eigen**2)
        left = np.sqrt(weight) * (field - idctn(gamma * spectrum, axes=axes, norm="ortho"))
        count = known.sum()
        return float((left**2).sum() / count / (1 - gamma.sum() / eigen.size) ** 2)

    return float(10 ** minimize_scalar(score, bounds=(-2, 4), method="bounded", options={"xatol": 0.1}).x)


def _bisquare(residual: np.ndarray, known: np.ndarray, strength: float, dimension: int) -> np.ndarray:
    """Weights from residuals over their spread and leverage (Garcia 2010, sec. 3.3)."""
    root = np.sqrt(1 + np.sqrt(1 + 16 * strength))
    leverage = (root / np.sqrt(2) / np.sqrt(1 + 16 * strength)) ** dimension
    spread = 1.4826 * np.median(np.abs(residual[known] - np.median(residual[known])))
    scaled = residual / max(spread * np.sqrt(max(1 - leverage, 1e-6)), 1e-12)
    return np.where(scaled / 4.685 < 1, (1 - (scaled / 4.685) ** 2) ** 2, 0.0)
