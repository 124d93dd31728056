"""What is to be thought of a measurement: a verdict for each thing that an analysis can suffer from.

The limits are rules of thumb for people, not results: they colour a word, and enter no computation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

import geometry
from geometry import Quality
from geometry.recordings.rules import measured_nodes

GOOD, FAIR, POOR, UNKNOWN = "good", "fair", "poor", "not known"
MAD_TO_DEVIATION = 1.4826
FAR = 4.0
"""Times the usual distance from which a value counts as an outlier where no filter has said so."""
AROUND = 2.0
"""Nodes, deviation of the Gaussian that tells what is usual around a node."""


@dataclass(frozen=True)
class Check:
    """One verdict.

    Args:
        name: what was looked at.
        verdict: "good", "fair", "poor" or "not known".
        found: with its numbers.
        means: what follows from it.
    """

    name: str
    verdict: str
    found: str
    means: str


def measurement_checks(
    measured: geometry.Recording,
    analysis: geometry.Recording,
    estimates: Mapping[str, Any] | None = None,
) -> list[Check]:
    """The verdicts on a measurement.

    Args:
        measured: it.
        analysis: made of it, on the same grid and frames; what is left between the two is taken for noise.
        estimates: what `geometry.Estimates.summary` says of walls and valves; None: nothing was mended.
    """
    left = _left(measured, analysis)
    return [
        _coverage(measured),
        _noise(measured, analysis, left),
        _outliers(measured, analysis, left),
        _walls(measured, estimates),
        *_findings(measured),
        _motion(analysis),
    ]


def _left(measured: geometry.Recording, analysis: geometry.Recording) -> np.ndarray:
    """Measurement less analysis (n, parts), m/s, at the measured nodes, in the components that were measured."""
    kind = geometry.measurement_type(measured)
    rest = kind.components(np.nan_to_num(measured.velocity - analysis.velocity).astype(np.float64))
    return np.moveaxis(rest, 1, -1)[measured_nodes(measured)]


def _coverage(measured: geometry.Recording) -> Check:
    inside, known = np.asarray(measured.mask, bool), measured_nodes(measured)
    axes = tuple(range(1, inside.ndim))
    share = known.sum(axes) / np.maximum(inside.sum(axes), 1)
    silent = int((share == 0).sum())
    least, mean = float(share.min()), float(known.sum() / max(int(inside.sum()), 1))
    verdict = GOOD if mean >= 0.8 and silent == 0 else FAIR if mean >= 0.4 else POOR
    text = f"{100 * mean:.0f} % of the blood was measured, {100 * least:.0f} % in the worst frame"
    if silent:
        text += f"; {silent} of {measured.frames} frames hold nothing"
    return Check("Coverage", verdict, text, "where nothing was measured, walls, valves and neighbours fill in")


def _noise(measured: geometry.Recording, analysis: geometry.Recording, left: np.ndarray) -> Check:
    means = "found: robust deviation of the measurement from the analysis; far above the stated one, errors are larger"
    if not len(left):
        return Check("Noise", UNKNOWN, "nothing was measured", means)
    found = MAD_TO_DEVIATION * np.median(np.abs(left), axis=0)
    names = "xyz" if left.shape[1] > 1 else ["along the beam"]
    said = ", ".join(f"{name} {value:.3g}" for name, value in zip(names, found, strict=False))
    level = float(np.sqrt(np.mean(found**2)))
    speed = float(np.sqrt(np.mean(np.square(analysis.velocity[_nodes(analysis)], dtype=np.float64))))
    text = f"found {said} m/s"
    verdict = GOOD if level < 0.5 * speed else FAIR if level < 1.5 * speed else POOR
    if measured.sigma is None:
        text += "; the file states none"
    else:
        sigma = measured.sigma[np.broadcast_to(measured_nodes(measured)[:, None], measured.sigma.shape)]
        stated = float(np.median(sigma)) if sigma.size else float("nan")
        text += f"; stated {stated:.3g} m/s (median)"
        if not 0.5 * stated <= level <= 2 * stated:  # a file may state 0
            verdict = POOR if level > 2 * stated else FAIR
    return Check("Noise", verdict, f"{text}; usual speed of the analysis {speed:.3g} m/s per component", means)


def _nodes(recording: geometry.Recording) -> np.ndarray:
    return np.broadcast_to(np.asarray(recording.mask, bool)[:, None], recording.velocity.shape)


def _outliers(measured: geometry.Recording, analysis: geometry.Recording, left: np.ndarray) -> Check:
    means = "values that contradict all around them; they were left out or hardly counted"
    if not len(left):
        return Check("Outliers", UNKNOWN, "nothing was measured", means)
    if analysis.quality is not None:
        used, out = (int((analysis.quality == code).sum()) for code in (Quality.USED, Quality.OUTLIER))
        share, how = out / max(used + out, 1), "were refused by the filter"
    else:
        share = float(_far(measured, analysis).mean())
        how = f"lie {FAR:g} times as far from the analysis as their surroundings"
    verdict = GOOD if share < 0.02 else FAIR if share < 0.1 else POOR
    return Check("Outliers", verdict, f"{100 * share:.2g} % of the measured nodes {how}", means)


def _far(measured: geometry.Recording, analysis: geometry.Recording) -> np.ndarray:
    """(n,) bool: measured nodes that are `FAR` times as far from the analysis as is usual, and as it is around them."""
    known = measured_nodes(measured)
    kind = geometry.measurement_type(measured)
    rest = kind.components(np.nan_to_num(measured.velocity - analysis.velocity).astype(np.float64))
    distance = np.where(known, np.sqrt((rest**2).sum(1)), 0.0)
    width = (0.0, *[AROUND] * measured.dimension)
    level = gaussian_filter(distance, width) / np.maximum(gaussian_filter(known.astype(float), width), 1e-9)
    usual = np.median(distance[known])
    return np.asarray(distance[known] > FAR * np.maximum(level[known], usual))


def _walls(measured: geometry.Recording, estimates: Mapping[str, Any] | None) -> Check:
    means = "a wall that flickers moves blood that did not move; it was smoothed in time, with its error"
    if measured.wall is None:
        return Check("Walls", FAIR, "the file has none", "the blood's border is taken from the mask alone")
    noise = _noise_of_walls(estimates)
    if noise is None:
        found = "steady from frame to frame" if measured.wall.moves else "at rest"
        return Check("Walls", GOOD, f"{found}: used as they are", "a wall that flickers would have been smoothed")
    share = noise / min(measured.grid.spacing)
    verdict = GOOD if share < 0.1 else FAIR if share < 0.5 else POOR
    return Check("Walls", verdict, f"flicker by {1e3 * noise:.2g} mm, {share:.2g} grid spacings", means)


def _noise_of_walls(estimates: Mapping[str, Any] | None) -> float | None:
    wall = (estimates or {}).get("wall")
    noise = wall.get("noise_m") if isinstance(wall, Mapping) else None
    return float(noise) if isinstance(noise, int | float) and noise > 0 else None


def _findings(measured: geometry.Recording) -> Iterator[Check]:
    found = geometry.findings(measured)
    wrapped = [one for one in found if "wrapped" in one.rule]
    if not wrapped:
        means = "speeds beyond a scanner's limit come back with the wrong sign"
        limit = measured.nyquist
        text = "no jump of twice a common limit between neighbours"
        if limit is not None:
            text = f"wraps at {limit.min():.3g} m/s, which is known and was taken back"
        yield Check("Aliasing", GOOD, text, means)
    for one in wrapped:
        yield Check("Aliasing", POOR, one.rule, one.cure)
    for one in found:
        if one not in wrapped:
            yield Check(f"Odd: {one.dataset}", POOR if one.severe else FAIR, one.rule, one.cure)


def _motion(analysis: geometry.Recording) -> Check:
    means = "blood that passes many nodes between frames is followed by the model more than by the measurement"
    if analysis.frames < 2:
        return Check("Frame rate", UNKNOWN, "there is one frame", means)
    interval = float(np.median(np.diff(analysis.time)))
    speed = np.sqrt(np.square(analysis.velocity, dtype=np.float64).sum(1))[np.asarray(analysis.mask, bool)]
    passed = float(np.quantile(speed, 0.99)) * interval / min(analysis.grid.spacing) if speed.size else 0.0
    verdict = GOOD if passed < 10 else FAIR if passed < 20 else POOR
    text = f"{1 / interval:.0f} frames a second; the fastest blood passes {passed:.1f} grid spacings between two"
    return Check("Frame rate", verdict, text, means)
