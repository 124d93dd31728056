"""Walls as data with errors: a smooth motion estimated from segmentations that flicker between frames.

The key frames' vertices are taken apart into modes (principal components over the frames). Each mode's course in time
is a smoothing spline with a noise level of its own (``smooth_in_time``), so that what many vertices do wrong together,
as a segmentation that is too large in one frame, is found as well as what every vertex does wrong by itself. Vertices
of one index are taken for one material point; where they slide along the wall between frames, that is motion as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geometry.arguments import checked
from geometry.recordings.recording import Recording, Wall

from .smooth_in_time import SmoothedSeries, SplineInTime
from .wall_motion import WallMotion

# flicker is nil where it changes dV/dt by less than this part of its RMS: then nothing of the wall is touched
_NIL = 0.01


@dataclass(frozen=True, eq=False)
class WallEstimate:
    """A wall's motion as estimated, with deviations, and what was found of the given one.

    Attributes:
        time: (K,) s, the key frames.
        vertices: (K, nv, D) m, estimated.
        velocity: (K, nv, D) m/s, their derivative, or None: the given wall stands, with its own velocity.
        noise: RMS error of a given coordinate of a vertex, m; 0 where none was found or could be looked for.
        sigma: (K,) RMS deviation of an estimated coordinate, m.
        velocity_sigma: (K,) RMS deviation of an estimated velocity component, m/s.
        volume_jitter: RMS difference of the given volume from the estimated one, m^3 (area, m^2, in a plane).
        rate_jitter: RMS difference of the given wall's dV/dt from the estimated one, m^3/s.
        rate: (K,) estimated dV/dt, m^3/s.
        rate_sigma: (K,) its deviation, m^3/s.
    """

    time: np.ndarray
    vertices: np.ndarray
    velocity: np.ndarray | None
    noise: float
    sigma: np.ndarray
    velocity_sigma: np.ndarray
    volume_jitter: float
    rate_jitter: float
    rate: np.ndarray
    rate_sigma: np.ndarray

    @property
    def uncertain(self) -> bool:
        """Whether the given wall flickers by more than nothing."""
        return self.velocity is not None

    @property
    def relative_jitter(self) -> float:
        """The given wall's error in dV/dt over the RMS of dV/dt itself; infinite for a wall that only flickers."""
        size = float(np.sqrt((self.rate**2).mean()))
        if size == 0.0:
            return 0.0 if self.rate_jitter == 0.0 else float("inf")
        return self.rate_jitter / size

    def applied(self, recording: Recording) -> Recording:
        """The recording with the estimated wall and its velocity; itself where nothing was found to mend."""
        if self.velocity is None:
            return recording
        wall = replace(
            recording.wall_for("an estimated wall"), vertices=self.vertices, velocity=self.velocity.astype(np.float32)
        )
        return replace(recording, wall=wall)

    def words(self) -> str:
        """One sentence for a person: how far the given volume jitters."""
        return (
            f"the walls' volume jitters by {1e6 * self.volume_jitter:.3g} ml between frames, "
            f"{self.relative_jitter:.2g} times what its trend explains in dV/dt; a smooth motion is used "
            f"(noise {1e3 * self.noise:.2g} mm, left {1e3 * float(np.sqrt((self.sigma**2).mean())):.2g} mm)"
        )


@checked
def estimate_wall(recording: Recording) -> WallEstimate:
    """Tell a recording's wall motion from the flicker of its segmentation.

    The level of the noise is found from the wall itself. Where it is nil (dV/dt changes by less than 1 % of its RMS),
    where the wall stands still, or where there are too few frames to tell, the given wall is returned as it is.

    Raises:
        RecordingError: the recording has no wall.
    """
    wall = recording.wall_for("estimate_wall")
    time = np.asarray(recording.time, np.float64)
    # the last frame may come close to the repetition of the first: the spline takes any distance but nought
    repeats = recording.period if recording.period and time[-1] - time[0] < recording.period * (1 - 1e-6) else 0.0
    if not wall.moves or len(time) < SplineInTime.least_times:
        return _as_given(recording, wall, time)
    given = np.asarray(wall.vertices, np.float64)
    flat = given.reshape(len(time), -1)
    middle = flat.mean(0)
    courses, sizes, shapes = np.linalg.svd(flat - middle, full_matrices=False)
    # a mode below round-off of the largest has no course of its own
    kept = sizes > 1e-9 * sizes[0] if sizes[0] > 0 else np.zeros(len(sizes), bool)
    if not kept.any():
        return _as_given(recording, wall, time)
    courses = courses[:, kept] * sizes[kept]
    series = SplineInTime(time, repeats).fit(courses)
    estimate = _assembled(recording, given, middle, shapes[kept], courses, series)
    return estimate if estimate.relative_jitter > _NIL else _as_given(recording, wall, time)


def _assembled(
    recording: Recording,
    given: np.ndarray,
    middle: np.ndarray,
    shapes: np.ndarray,
    courses: np.ndarray,
    series: SmoothedSeries,
) -> WallEstimate:
    """The estimate from the modes' shapes (n, nv D), courses (K, n) as given, and these as estimated."""
    wall, time = recording.wall_for("an estimated wall"), np.asarray(recording.time, np.float64)
    vertices = (middle + series.value @ shapes).reshape(given.shape)
    velocity = (series.rate @ shapes).reshape(given.shape)
    motion = WallMotion.through(time, vertices, wall.faces, wall.region, rates=velocity)
    # both by differences of the positions, so that what differences miss of a smooth motion does not count as flicker
    before, after = (WallMotion.through(time, x, wall.faces, wall.region) for x in (given, vertices))
    swept = np.stack([_swept_by(motion, t, shapes) for t in time])
    width = given[0].size
    noise = float(np.sqrt((series.noise**2).sum() / width))
    # a mode's shape is a mean of the frames, weighted by its course: it carries its part of their errors along
    power = (courses**2).sum(0)
    of_shapes = noise**2 * (series.value**2 / power).sum(1)
    return WallEstimate(
        time=time,
        vertices=vertices,
        velocity=velocity,
        noise=noise,
        sigma=np.sqrt(series.value_variance.sum(1) / width + of_shapes),
        velocity_sigma=np.sqrt(series.rate_variance.sum(1) / width),
        volume_jitter=_rms([before.volume(t) - after.volume(t) for t in time]),
        rate_jitter=_rms([before.volume_rate(t) - after.volume_rate(t) for t in time]),
        rate=np.array([motion.volume_rate(t) for t in time]),
        rate_sigma=np.sqrt((swept**2 * series.rate_variance).sum(1)),
    )


def _swept_by(motion: WallMotion, t: float, shapes: np.ndarray) -> np.ndarray:
    """Volume (n,) that the surface at a time sweeps per unit of each mode: the fluxes of their shapes."""
    surface = motion.surface(t)
    # each vertex carries a share of its faces' area vectors, so that one product serves all modes
    carried = np.zeros_like(surface.vertices)
    for corner in range(surface.dimension):
        np.add.at(carried, surface.faces[:, corner], surface.area_vectors / surface.dimension)
    return shapes @ carried.ravel()


def _as_given(recording: Recording, wall: Wall, time: np.ndarray) -> WallEstimate:
    motion = WallMotion.from_recording(recording)
    vertices = wall.vertices if wall.moves else np.broadcast_to(wall.vertices, (len(time), *wall.vertices.shape))
    nothing = np.zeros(len(time))
    rate = np.array([motion.volume_rate(t) for t in time])
    return WallEstimate(time, vertices, None, 0.0, nothing, nothing, 0.0, 0.0, rate, nothing)


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
