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

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

import geometry

__all__ = ["METRICS", "UNITS", "Score", "Scores", "evaluate", "matching_frames", "spread_over_skill"]

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

SAME_TIME = 1e-6
"""Frames closer than this (s) are the same instant: far below any frame interval, far above round-off."""


@dataclass(frozen=True)
class Score:
    """One measure: over the whole recording, and of each frame (`None` where it is not defined)."""

    value: float | None
    per_frame: list[float | None]


Scores = dict[str, Score]


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
        reference = _on_frames_of(truth, recording, "the truth")
        mask = np.asarray(reference.mask, bool)
        scores |= velocity_scores(velocity, np.asarray(reference.velocity), mask)
    scores["divergence_rms"] = divergence_rms(velocity, mask, recording.grid.spacing)
    if reference.wall is not None:
        scores["wall_normal_rms"] = wall_normal_rms(velocity, mask, reference)
        scores["flow_rate_error"] = flow_rate_error(velocity, mask, reference)
    if measured is not None:
        scores["residual_rms"] = residual_rms(velocity, _on_frames_of(measured, recording, "the measurement"))
    return scores


def spread_over_skill(recording: geometry.Recording, truth: geometry.Recording) -> Score | None:
    """RMS of `sigma` over the RMS error of the velocity, over the truth's mask: 1 where the claim is right.

    `None` for a recording without `sigma`.
    """
    if recording.sigma is None:
        return None
    reference = _on_frames_of(truth, recording, "the truth")
    mask = np.asarray(reference.mask, bool)
    error = _square_sums(filled_velocity(recording) - np.where(mask[:, None], reference.velocity, 0), mask)
    claimed = _square_sums(np.nan_to_num(recording.sigma), mask)

    def score(total: float, wrong: float) -> float | None:
        return _root_mean(float(total), float(wrong))

    return Score(score(claimed.sum(), error.sum()), [score(c, e) for c, e in zip(claimed, error, strict=True)])


def filled_velocity(recording: geometry.Recording) -> np.ndarray:
    """The velocity (T, D, *shape), m/s, with 0 where the recording has no value."""
    known = np.asarray(recording.mask, bool)
    if recording.weight is not None:
        known = known & (np.asarray(recording.weight) > 0)
    velocity = np.asarray(recording.velocity)
    return np.where(known[:, None] & np.isfinite(velocity), velocity, 0)


# --- against the truth ----------------------------------------------------------------------------


def velocity_scores(velocity: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> Scores:
    """The four measures that compare two velocities (T, D, *shape), m/s, over a mask (T, *shape)."""
    truth = np.where(mask[:, None], truth, 0)
    speed, true_speed = np.linalg.norm(velocity, axis=1), np.linalg.norm(truth, axis=1)
    error = _square_sums((velocity - truth), mask)
    magnitude = _square_sums((speed - true_speed)[:, None], mask)
    nodes = mask.reshape(len(mask), -1).sum(1)
    rms_truth = _root_mean(_square_sums(truth, mask).sum(), nodes.sum())
    fastest = float(true_speed.max(initial=0.0))
    return {
        "nrmse": _rms_score(error, nodes, rms_truth),
        "vnrmse": _rms_score(error, nodes, fastest),
        "magnitude_nrmse": _rms_score(magnitude, nodes, rms_truth),
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
    return Score(_ratio(sums.sum(), counts.sum()), [_ratio(s, n) for s, n in zip(sums, counts, strict=True)])


# --- of one field ---------------------------------------------------------------------------------


def divergence_rms(velocity: np.ndarray, mask: np.ndarray, spacing: np.ndarray) -> Score:
    """RMS divergence, 1/s, of a velocity (T, D, *shape), m/s, on a grid of `spacing` (D,), m (x first)."""
    sums, counts = np.zeros(len(mask)), np.zeros(len(mask), int)
    for frame, inside in enumerate(mask):
        interior = _interior(inside)
        divergence = central_divergence(velocity[frame].astype(np.float64), spacing)
        sums[frame], counts[frame] = np.sum(divergence[interior] ** 2), interior.sum()
    return _rms_score(sums, counts, 1.0)


def central_divergence(velocity: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Second-order central differences of (D, *shape); the nodes on the border of the grid hold 0."""
    divergence = np.zeros(velocity.shape[1:])
    for component, step in enumerate(np.asarray(spacing, float)):
        axis = velocity.ndim - 2 - component  # components run x, y, z; array axes z, y, x
        middle, after, before = (_along(divergence.ndim, axis, s) for s in (_MIDDLE, _AFTER, _BEFORE))
        divergence[middle] += (velocity[component][after] - velocity[component][before]) / (2 * step)
    return divergence


_MIDDLE, _AFTER, _BEFORE = slice(1, -1), slice(2, None), slice(None, -2)


def _along(dimension: int, axis: int, part: slice) -> tuple[slice, ...]:
    return tuple(part if a == axis else slice(None) for a in range(dimension))


def _interior(inside: np.ndarray) -> np.ndarray:
    """Nodes of a mask that have both neighbours along every axis in it."""
    interior = inside.copy()
    for axis in range(inside.ndim):
        whole = np.zeros_like(inside)
        whole[_along(inside.ndim, axis, _MIDDLE)] = (
            inside[_along(inside.ndim, axis, _AFTER)] & inside[_along(inside.ndim, axis, _BEFORE)]
        )
        interior &= whole
    return interior


# --- at the wall and the orifices -----------------------------------------------------------------


@dataclass(frozen=True)
class _Faces:
    """The surface at one time, face by face: fluid velocity relative to it along the outward area vector."""

    region: np.ndarray  # (nf,)
    area: np.ndarray  # (nf,) m2 (m in a plane recording)
    relative_flow: np.ndarray  # (nf,) (v - w) . n A, m3/s
    swept: np.ndarray  # (nf,) w . n A, m3/s; sums to dV/dt
    covered: np.ndarray  # (nf,) bool: a node of the mask lies around the face


def wall_normal_rms(velocity: np.ndarray, mask: np.ndarray, recording: geometry.Recording) -> Score:
    """RMS, by area, of the flow through the wall faces, m/s: what impermeability says is 0."""
    sums, areas = np.zeros(len(mask)), np.zeros(len(mask))
    for frame, faces in enumerate(_faces(velocity, mask, recording)):
        chosen = (faces.region == 0) & faces.covered & (faces.area > 0)
        sums[frame] = np.sum(faces.relative_flow[chosen] ** 2 / faces.area[chosen])
        areas[frame] = faces.area[chosen].sum()
    return _rms_score(sums, areas, 1.0)


def flow_rate_error(velocity: np.ndarray, mask: np.ndarray, recording: geometry.Recording) -> Score:
    """Relative RMS error of the net flow rate into the blood; the reference comes from `recording`."""
    flow, swept = np.zeros(len(mask)), np.zeros(len(mask))
    for frame, faces in enumerate(_faces(velocity, mask, recording)):
        flow[frame] = -np.sum(faces.relative_flow[(faces.region > 0) & faces.covered])
        swept[frame] = faces.swept.sum()
    given = [flux for flux in (recording.flux_mitral, recording.flux_aortic) if flux is not None]
    reference = np.sum(given, axis=0) if given else swept
    scale = _root_mean(np.sum(reference**2), len(reference))
    return _rms_score((flow - reference) ** 2, np.ones(len(mask)), scale)


def _faces(velocity: np.ndarray, mask: np.ndarray, recording: geometry.Recording) -> Iterator[_Faces]:
    motion, wall = geometry.WallMotion.from_recording(recording), recording.wall_for("metrics of the wall")
    for frame, time in enumerate(recording.time):
        surface = wall.at(frame)
        wall_velocity = np.asarray(motion.velocity(float(time)), np.float64)[surface.faces].mean(1)
        fluid, covered = sample_inside(recording.grid, velocity[frame], mask[frame], surface.centroids)
        yield _Faces(
            region=surface.region,
            area=surface.areas,
            relative_flow=np.einsum("fd,fd->f", fluid - wall_velocity, surface.area_vectors),
            swept=np.einsum("fd,fd->f", wall_velocity, surface.area_vectors),
            covered=covered,
        )


def sample_inside(
    grid: geometry.Grid, velocity: np.ndarray, mask: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (n, D) at points (n, D) from the nodes inside the mask alone, and where there was one (n,).

    The zeros beyond the wall would otherwise halve every velocity at it, the true one included.
    """
    inside = torch.as_tensor(np.asarray(mask, np.float64))
    values = torch.as_tensor(np.asarray(velocity, np.float64)) * inside
    where = torch.as_tensor(np.asarray(points, np.float64))
    share = grid.sample(inside[None], where)[0]
    covered = share > 1e-6
    sampled = grid.sample(values, where) / torch.where(covered, share, 1.0)
    return (sampled * covered).T.numpy(), covered.numpy()


# --- against the measurement ----------------------------------------------------------------------


def residual_rms(velocity: np.ndarray, measured: geometry.Recording) -> Score:
    """Weighted RMS distance, m/s, to the measurement where there is one; along its beam where it has one."""
    observed = np.asarray(measured.velocity)
    known = np.asarray(measured.mask, bool) & np.isfinite(observed).all(1)
    weight = np.where(known, 1.0 if measured.weight is None else np.asarray(measured.weight), 0.0)
    if measured.beam is not None:
        beam = np.asarray(measured.beam)
        velocity = (velocity * beam).sum(1, keepdims=True) * beam
    square = np.sum((velocity - np.where(known[:, None], observed, 0)).astype(np.float64) ** 2, axis=1)
    axes = tuple(range(1, square.ndim))
    return _rms_score((weight * square).sum(axes), weight.sum(axes), 1.0)


# --- frames and sums ------------------------------------------------------------------------------


def matching_frames(times: np.ndarray, among: np.ndarray, what: str) -> np.ndarray:
    """Indices into `among` of the frames at `times` (s); `ValueError` if one is missing."""
    nearest = np.abs(np.asarray(among)[None, :] - np.asarray(times)[:, None]).argmin(1)
    missing = np.abs(np.asarray(among)[nearest] - times) > SAME_TIME
    if missing.any():
        raise ValueError(
            f"{what} has no frame at {float(np.asarray(times)[missing][0]):.6g} s ({int(missing.sum())} of "
            f"{len(times)} times missing); give one with a frame at every time of the measurement"
        )
    return nearest


def _on_frames_of(other: geometry.Recording, recording: geometry.Recording, what: str) -> geometry.Recording:
    mine, its = recording.grid, other.grid
    same = tuple(mine.shape) == tuple(its.shape) and np.allclose(mine.spacing, its.spacing, rtol=1e-6)
    if not same or not np.allclose(mine.origin, its.origin, atol=1e-3 * float(np.min(mine.spacing))):
        raise ValueError(
            f"{what} lies on another grid than the recording ({_grid_text(its)}; not {_grid_text(mine)}); "
            "sample it onto the recording's grid first"
        )
    return other.select(matching_frames(recording.time, other.time, what))


def _grid_text(grid: geometry.Grid) -> str:
    return f"shape {tuple(grid.shape)}, origin {tuple(grid.origin)}, spacing {tuple(grid.spacing)}"


def _square_sums(field: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Sum over the mask and the components of a field (T, C, *shape), frame by frame, in float64: (T,)."""
    return np.array([np.sum(f[:, m].astype(np.float64) ** 2) for f, m in zip(field, mask, strict=True)])


def _rms_score(sums: np.ndarray, counts: np.ndarray, scale: float | None) -> Score:
    def score(total: float, count: float) -> float | None:
        root = _root_mean(total, count)
        return None if root is None or not scale else root / scale

    return Score(score(sums.sum(), counts.sum()), [score(s, n) for s, n in zip(sums, counts, strict=True)])


def _root_mean(total: float, count: float) -> float | None:
    mean = _ratio(total, count)
    return None if mean is None else float(np.sqrt(mean))


def _ratio(total: float, count: float) -> float | None:
    return float(total) / float(count) if count > 0 else None
