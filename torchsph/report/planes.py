"""Three planes through a flow: along the axis and the valves, across them, and across the axis halfway down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.ndimage import binary_dilation

import geometry
from geometry.grids.fields import continued, masked_gradient
from torchsph.evaluation.metrics import filled_velocity
from torchsph.evaluation.slices import Plane, body_points, valve_plane
from torchsph.haemodynamics.fields.sampling import sample_in_mask
from torchsph.haemodynamics.vorticity import vorticity

from .packing import Packed, packed, packed_numbers, packed_places

MARGIN = 0.03
"""Of the largest side of a plane, around the blood."""


@dataclass(frozen=True)
class View:
    """A plane with its name, for people."""

    name: str
    plane: Plane

    def pixels(self, pixel: float) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (ns,) across and (nt,) along, m."""
        s0, s1, t0, t1 = self.plane.extent
        return np.arange(s0, s1 + pixel, pixel), np.arange(t0, t1 + pixel, pixel)

    def points(self, pixel: float) -> np.ndarray:
        """All pixels (nt * ns, D), m."""
        s, t = self.pixels(pixel)
        places = self.plane.origin + s[None, :, None] * self.plane.across + t[:, None, None] * self.plane.along
        return places.reshape(-1, len(self.plane.origin))


def views(recording: geometry.Recording) -> list[View]:
    """The planes that are shown: three in space; a plane recording is its own."""
    first = valve_plane(recording)
    if recording.dimension == 2:
        return [View("plane", first)]
    body = body_points(recording)
    normal = np.cross(first.along, first.across)
    heights = (body - first.origin) @ first.along
    middle = first.origin + 0.5 * (heights.min() + heights.max()) * first.along
    return [
        View("long axis, through the valves", first),
        View("long axis, across the valves", _fitted(body, first.origin, normal, first.along)),
        View("short axis, halfway", _fitted(body, middle, first.across, normal)),
    ]


def _fitted(body: np.ndarray, origin: np.ndarray, across: np.ndarray, along: np.ndarray) -> Plane:
    s, t = (body - origin) @ across, (body - origin) @ along
    margin = MARGIN * max(float(np.ptp(s)), float(np.ptp(t)))
    # off the mesh's own planes of symmetry by a hair: a plane through vertices cuts triangles in degenerate ways
    moved = origin + 1e-7 * np.cross(across, along)
    return Plane(moved, across, along, (s.min() - margin, s.max() + margin, t.min() - margin, t.max() + margin))


def drawn_channels(recording: geometry.Recording) -> list[str]:
    """Scalars that a recording has beside its velocity."""
    found = ["vorticity"]
    if recording.sigma is not None:
        found.append("deviation")
    if recording.pressure is not None:
        found.append("pressure")
    return found


def cut_fields(recording: geometry.Recording, shown: Sequence[View], pixel: float) -> list[dict[str, Packed]]:
    """Velocity and scalars of all frames in each plane.

    Args:
        recording: velocities, and what else there is.
        shown: the planes.
        pixel: m.

    Returns:
        For each plane `velocity` (T, 2 or 3, nt, ns): across, along and, in space, through the plane towards the eye,
        m/s; `vorticity` (T, nt, ns) around that direction, 1/s; `deviation` (T, nt, ns), of the vector, m/s;
        `pressure` (T, nt, ns), Pa; and `known` (T, nt, ns), 1 where a node with a value is near.
    """
    velocity, known = filled_velocity(recording), _known(recording)
    points = [view.points(pixel) for view in shown]
    series: list[dict[str, list[np.ndarray]]] = [{} for _ in shown]
    for frame in range(recording.frames):
        fields = _fields(recording, velocity[frame], known[frame], frame)
        for view, places, found in zip(shown, points, series, strict=True):
            for name, values in _cut(recording, view, places, pixel, fields, known[frame]).items():
                found.setdefault(name, []).append(values)
    return [
        {name: (packed_numbers if name == "known" else packed)(np.stack(values)) for name, values in one.items()}
        for one in series
    ]


def _known(recording: geometry.Recording) -> np.ndarray:
    """(T, *shape) bool: nodes of the blood with a value."""
    inside = np.asarray(recording.mask, bool)
    measured = inside if recording.weight is None else inside & (np.asarray(recording.weight) > 0)
    return np.asarray(measured & np.isfinite(recording.velocity).all(1))


def _fields(
    recording: geometry.Recording, velocity: np.ndarray, known: np.ndarray, frame: int
) -> dict[str, np.ndarray]:
    """Of one frame: `velocity` (D, *shape), `vorticity` (3 or 1, *shape), and the scalars (1, *shape)."""
    values = torch.from_numpy(np.asarray(velocity, np.float64))
    gradient = masked_gradient(values, torch.from_numpy(known), recording.grid.spacing).numpy()
    curl = vorticity(gradient)
    found = {"velocity": velocity, "vorticity": curl if recording.dimension == 3 else curl[None]}
    if recording.sigma is not None:
        found["deviation"] = np.sqrt(np.square(np.nan_to_num(recording.sigma[frame])).sum(0))[None]
    if recording.pressure is not None:
        found["pressure"] = np.nan_to_num(recording.pressure[frame])[None]
    return found


def _cut(
    recording: geometry.Recording,
    view: View,
    places: np.ndarray,
    pixel: float,
    fields: Mapping[str, np.ndarray],
    known: np.ndarray,
) -> dict[str, np.ndarray]:
    plane, size = view.plane, tuple(len(ticks) for ticks in reversed(view.pixels(pixel)))
    stacked = np.concatenate(list(fields.values()))
    values, share = sample_in_mask(recording.grid, stacked, known, places)
    covered = (share > 1e-6).reshape(size)
    values = values.reshape(-1, *size)
    if covered.any():  # the nearest values go on beyond the blood, so that the page can interpolate up to the wall
        values = continued(values, covered)
    parts, first = {}, 0
    for name, field in fields.items():
        parts[name] = values[first : first + len(field)]
        first += len(field)
    axes = [plane.across, plane.along]
    if recording.dimension == 3:
        axes.append(np.cross(plane.across, plane.along))
        parts["vorticity"] = np.einsum("d,d...->...", axes[2], parts["vorticity"])[None]
    parts["velocity"] = np.einsum("ad,d...->a...", np.stack(axes), parts["velocity"])
    found = {name: part if name == "velocity" else part[0] for name, part in parts.items()}
    # a point more, where the wall lies beyond the last node; inside a hole it is the nearest value that goes on
    return found | {"known": binary_dilation(covered)}


def outlines(recording: geometry.Recording, view: View) -> dict[str, Any] | None:
    """Where the wall cuts a plane: `places` (n, 4) as s, t of both ends (m), `region` (n,), `first` of each frame.

    None without a wall.
    """
    if recording.wall is None:
        return None
    places, regions, first = [np.zeros((0, 4))], [np.zeros(0, np.uint8)], [0]
    for frame in range(recording.frames):
        ends, region = _outline(recording.wall.at(frame), view.plane)
        places.append(ends)
        regions.append(region)
        first.append(first[-1] + len(ends))
    return {
        "places": packed_places(np.concatenate(places)),
        "region": packed_numbers(np.concatenate(regions)),
        "first": first,
    }


def _outline(surface: geometry.Surface, plane: Plane) -> tuple[np.ndarray, np.ndarray]:
    if len(plane.origin) == 2:
        segments, faces = surface.vertices[surface.faces], np.arange(len(surface.faces))
    else:
        normal = np.cross(plane.across, plane.along)
        segments, faces = trimesh.intersections.mesh_plane(surface.trimesh(), normal, plane.origin, return_faces=True)
    relative = np.asarray(segments).reshape(-1, 2, len(plane.origin)) - plane.origin
    ends = np.stack([relative @ plane.across, relative @ plane.along], axis=-1).reshape(-1, 4)
    return ends, np.asarray(surface.region)[np.asarray(faces, int)]
