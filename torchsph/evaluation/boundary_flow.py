"""Flow through the walls and the orifices of a recording, face by face."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

import geometry

from .scores import Score, rms_score, root_mean


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
    return rms_score(sums, areas, 1.0)


def flow_rate_error(velocity: np.ndarray, mask: np.ndarray, recording: geometry.Recording) -> Score:
    """Relative RMS error of the net flow rate into the blood; the reference comes from `recording`."""
    flow, swept = np.zeros(len(mask)), np.zeros(len(mask))
    for frame, faces in enumerate(_faces(velocity, mask, recording)):
        flow[frame] = -np.sum(faces.relative_flow[(faces.region > 0) & faces.covered])
        swept[frame] = faces.swept.sum()
    given = [flux for flux in (recording.flux_mitral, recording.flux_aortic) if flux is not None]
    reference = np.sum(given, axis=0) if given else swept
    scale = root_mean(np.sum(reference**2), len(reference))
    return rms_score((flow - reference) ** 2, np.ones(len(mask)), scale)


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
