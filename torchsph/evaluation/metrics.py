"""Error measures of a velocity recording, each with its formula.

Notation. v is the velocity under test, u the true one, both (T, D, *shape) in m/s; M is the truth's mask
(the recording's own where there is no truth) and <.> the mean over the nodes of M in all T frames. A node of
M where the recording has no value (not a number, weight 0, or outside its mask) counts as v = 0: a method
cannot gain by leaving nodes out.

| name | formula | unit |
|---|---|---|
| `nrmse` | sqrt(<abs(v - u)^2>) / sqrt(<abs(u)^2>) | 1 |
| `vnrmse` | sqrt(<abs(v - u)^2>) / max abs(u) | 1 |
| `magnitude_nrmse` | sqrt(<(abs(v) - abs(u))^2>) / sqrt(<abs(u)^2>) | 1 |
| `direction_error_deg` | mean angle between v and u where abs(u) > 0.1 max abs(u); zero v: 90 | degrees |
| `divergence_rms` | sqrt(<(div v)^2>), central differences, nodes whose 2 D neighbours lie in M | 1/s |
| `wall_normal_rms` | sqrt(<((v - w).n)^2>) over the faces of the wall (region 0), by area | m/s |
| `flow_rate_error` | RMS over time of (Q - Q_ref) / RMS over time of Q_ref | 1 |
| `residual_rms` | sqrt(<W abs(v - m)^2> / <W>) against the measurement m with weights W | m/s |

Q(t) is the net flow rate into the blood through all orifices (regions above 0) relative to their own motion,
from v at the faces; Q_ref the truth's flow rates where it has them, else the dV/dt of the moving surface,
which equals it for an incompressible fluid. At a face v is interpolated from the nodes of M around it alone
(multilinear weights renormalised over them); a face with no such node is left out of `wall_normal_rms` and
carries nothing into Q.

Every measure also has a value per frame: the same formula with the sums over that frame and, in the ratios,
the denominators of the whole recording, so that quiet frames do not divide by next to nothing. A measure
that is not defined (no face, a fluid at rest as the truth) is `None`.
"""

from __future__ import annotations

import numpy as np

import geometry

from .boundary_flow import flow_rate_error, wall_normal_rms
from .divergence import divergence_rms
from .frames import on_frames_of
from .scores import Score, Scores, ratio, rms_score, root_mean, square_sums

__all__ = ["METRICS", "UNITS", "Score", "Scores", "evaluate", "spread_over_skill"]

UNITS = {
    "nrmse": "1",
    "vnrmse": "1",
    "magnitude_nrmse": "1",
    "direction_error_deg": "deg",
    "divergence_rms": "1/s",
    "wall_normal_rms": "m/s",
    "flow_rate_error": "1",
    "residual_rms": "m/s",
}
METRICS = tuple(UNITS)

FAST_FRACTION = 0.1
"""Nodes slower than this share of the highest true speed have no direction worth scoring."""


def evaluate(
    recording: geometry.Recording,
    truth: geometry.Recording | None = None,
    measured: geometry.Recording | None = None,
) -> Scores:
    """Every measure that can be had of `recording`, by name.

    Without `truth` those that compare with it are left out, without `measured` the residual. The truth may
    have more frames than the recording, but needs one at each of its times, on the same grid (`ValueError`).
    """
    velocity, mask = filled_velocity(recording), np.asarray(recording.mask, bool)
    reference = recording
    scores: Scores = {}
    if truth is not None:
        reference = on_frames_of(truth, recording, "the truth")
        mask = np.asarray(reference.mask, bool)
        scores |= velocity_scores(velocity, np.asarray(reference.velocity), mask)
    scores["divergence_rms"] = divergence_rms(velocity, mask, recording.grid.spacing)
    if reference.wall is not None:
        scores["wall_normal_rms"] = wall_normal_rms(velocity, mask, reference)
        scores["flow_rate_error"] = flow_rate_error(velocity, mask, reference)
    if measured is not None:
        scores["residual_rms"] = residual_rms(velocity, on_frames_of(measured, recording, "the measurement"))
    return scores


def spread_over_skill(recording: geometry.Recording, truth: geometry.Recording) -> Score | None:
    """RMS of `sigma` over the RMS error of the velocity, over the truth's mask: 1 where the claim is right.

    `None` for a recording without `sigma`.
    """
    if recording.sigma is None:
        return None
    reference = on_frames_of(truth, recording, "the truth")
    mask = np.asarray(reference.mask, bool)
    error = square_sums(filled_velocity(recording) - np.where(mask[:, None], reference.velocity, 0), mask)
    claimed = square_sums(np.nan_to_num(recording.sigma), mask)

    def score(total: float, wrong: float) -> float | None:
        return root_mean(float(total), float(wrong))

    return Score(score(claimed.sum(), error.sum()), [score(c, e) for c, e in zip(claimed, error, strict=True)])


def filled_velocity(recording: geometry.Recording) -> np.ndarray:
    """The velocity (T, D, *shape), m/s, with 0 where the recording has no value."""
    known = np.asarray(recording.mask, bool)
    if recording.weight is not None:
        known = known & (np.asarray(recording.weight) > 0)
    velocity = np.asarray(recording.velocity)
    return np.where(known[:, None] & np.isfinite(velocity), velocity, 0)


def gaps(recording: geometry.Recording) -> np.ndarray:
    """(T, *shape) bool: nodes in the blood where the recording has no value: not finite, or of weight 0."""
    unknown = ~np.isfinite(recording.velocity).all(axis=1)
    if recording.weight is not None:
        unknown |= ~(np.asarray(recording.weight) > 0)
    return np.asarray(recording.mask, bool) & unknown


# --- against the truth ----------------------------------------------------------------------------


def velocity_scores(velocity: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> Scores:
    """The four measures that compare two velocities (T, D, *shape), m/s, over a mask (T, *shape)."""
    truth = np.where(mask[:, None], truth, 0)
    speed, true_speed = np.linalg.norm(velocity, axis=1), np.linalg.norm(truth, axis=1)
    error = square_sums((velocity - truth), mask)
    magnitude = square_sums((speed - true_speed)[:, None], mask)
    nodes = mask.reshape(len(mask), -1).sum(1)
    rms_truth = root_mean(square_sums(truth, mask).sum(), nodes.sum())
    fastest = float(true_speed.max(initial=0.0))
    return {
        "nrmse": rms_score(error, nodes, rms_truth),
        "vnrmse": rms_score(error, nodes, fastest),
        "magnitude_nrmse": rms_score(magnitude, nodes, rms_truth),
        "direction_error_deg": _direction_score(velocity, truth, true_speed > FAST_FRACTION * fastest),
    }


def _direction_score(velocity: np.ndarray, truth: np.ndarray, fast: np.ndarray) -> Score:
    sums, counts = np.zeros(len(fast)), fast.reshape(len(fast), -1).sum(1)
    for frame, chosen in enumerate(fast):
        v, u = (field[frame][:, chosen].astype(np.float64) for field in (velocity, truth))
        # The half-angle form (Kahan) is exact near 0 and 180 degrees; arccos loses half the digits.
        v_size, u_size = np.linalg.norm(v, axis=0), np.linalg.norm(u, axis=0)
        angle = 2 * np.arctan2(
            np.linalg.norm(v * u_size - u * v_size, axis=0), np.linalg.norm(v * u_size + u * v_size, axis=0)
        )
        sums[frame] = np.where(v_size > 0, np.degrees(angle), 90.0).sum()
    return Score(ratio(sums.sum(), counts.sum()), [ratio(s, n) for s, n in zip(sums, counts, strict=True)])


# --- against the measurement ----------------------------------------------------------------------


def residual_rms(velocity: np.ndarray, measured: geometry.Recording) -> Score:
    """Weighted RMS distance, m/s, to the measurement where there is one, in the components that it holds."""
    observed = np.asarray(measured.velocity)
    known = np.asarray(measured.mask, bool) & np.isfinite(observed).all(1)
    weight = np.where(known, 1.0 if measured.weight is None else np.asarray(measured.weight), 0.0)
    velocity = geometry.measurement_type(measured).projected(velocity)
    square = np.sum((velocity - np.where(known[:, None], observed, 0)).astype(np.float64) ** 2, axis=1)
    axes = tuple(range(1, square.ndim))
    return rms_score((weight * square).sum(axes), weight.sum(axes), 1.0)
