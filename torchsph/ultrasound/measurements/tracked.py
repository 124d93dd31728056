"""From images of a scanner, or velocities of one, to a recording: what a lab does with volumes that it already has."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from geometry import Grid, Recording

from ..acquisition import Beams, Packet
from ..estimation.plugin import Tracker
from ..estimation.tracking import SpeckleTracker
from ..uff import UffVolumes, read_uff


@dataclass(frozen=True)
class TrackingPlan:
    """Where and how often :func:`track_recording` estimates velocities.

    Args:
        spacing: m, of the recording's grid, made a whole number of image nodes.
        images: that make one estimate; 0 = all of them.
        tracker: who estimates.
        rho: kg/m^3, of the blood.
        mu: Pa s.
    """

    spacing: float = 1e-3
    images: int = 0
    tracker: Tracker = field(default_factory=SpeckleTracker)
    rho: float = 1060.0
    mu: float = 0.004

    def __post_init__(self) -> None:
        if not (math.isfinite(self.spacing) and self.spacing > 0):
            raise ValueError(f"spacing must be positive and finite, got {self.spacing!r}")
        if self.images < 0 or self.images == 1:
            raise ValueError(f"images must be 0 or at least 2, got {self.images!r}")


def track_recording(packet: Packet, plan: TrackingPlan | None = None, *, description: str = "") -> Recording:
    """Velocities of images as a recording without walls, one frame for each packet of `plan.images` images.

    The weight of an accepted estimate is its correlation, that of others 0. A frame's time is the middle of its
    images, the first of which is at 0; images that do not fill a packet are left out.

    Args:
        packet: images, any number.
        plan: where and how often to track.
        description: of the recording.

    Raises:
        ValueError: for fewer images than one estimate takes, or a phase that fits no convention.
    """
    plan = plan or TrackingPlan()
    count = plan.images or len(packet.iq)
    frames = len(packet.iq) // count
    if frames == 0:
        raise ValueError(f"an estimate takes {count} images, there are {len(packet.iq)}")
    grid = coarser(packet.grid, plan.spacing)
    points, interval = grid.nodes(), packet.acquisition.interval
    velocity = np.zeros((frames, grid.dimension, *grid.shape), np.float32)
    weight = np.zeros((frames, *grid.shape), np.float32)
    for frame in range(frames):
        images = packet.iq[frame * count : (frame + 1) * count]
        found = plan.tracker.track(packet.with_iq(images, noise=packet.noise, phase=packet.phase), points)
        kept = torch.where(found.accepted[:, None], found.velocity, 0)
        velocity[frame] = kept.T.reshape(-1, *grid.shape).cpu().numpy()
        sure = torch.where(found.accepted, found.correlation.clamp(0, 1), 0)
        weight[frame] = sure.reshape(grid.shape).cpu().numpy()
    time = (np.arange(frames) * count + 0.5 * (count - 1)) * interval
    return Recording(
        time,
        grid,
        velocity,
        np.ones(weight.shape, bool),
        None,
        plan.rho,
        plan.mu,
        weight=weight,
        description=description or f"tracked in packets of {count} images",
    )


def read_uff_recording(
    path: str | Path,
    name: str = "beamformed_data",
    *,
    beams: Beams | None = None,
    plan: TrackingPlan | None = None,
    sound_speed: float = 1540.0,
) -> Recording:
    """The volumes of a UFF file as a recording without walls: IQ is tracked, velocities are taken as they are.

    Args:
        path: of the file.
        name: of the object in it.
        beams: along which IQ was taken; ``None`` = parallel, along the last axis.
        plan: where and how often to track IQ; its fluid goes into every recording.
        sound_speed: m/s.

    Raises:
        FileNotFoundError: where there is no such file.
        ImportError: without pyuff_ustb.
        ValueError: where the data are missing, lack their rates, fill no regular grid, or are neither IQ nor
            velocities.
    """
    volumes, plan = read_uff(path, name), plan or TrackingPlan()
    described = f"{name} of {Path(path).name}"
    if np.iscomplexobj(volumes.values):
        axis = (0.0,) * (volumes.grid.dimension - 1) + (1.0,)
        packet = volumes.packet(beams or Beams(axis), sound_speed=sound_speed)
        return track_recording(packet, plan, description=f"{described}, tracked")
    return _velocities(volumes, plan, described, str(path))


def coarser(grid: Grid, spacing: float) -> Grid:
    """The grid of every n-th node, as near to a spacing, m, as whole numbers of nodes come, in the middle of it."""
    steps = [max(1, round(spacing / step)) for step in grid.spacing]
    counts = [(count - 1) // step + 1 for count, step in zip(reversed(grid.shape), steps, strict=True)]
    left = [
        (count - 1 - (kept - 1) * step) // 2
        for count, kept, step in zip(reversed(grid.shape), counts, steps, strict=True)
    ]
    origin = tuple(a + skip * h for a, skip, h in zip(grid.origin, left, grid.spacing, strict=True))
    return Grid(origin, tuple(n * h for n, h in zip(steps, grid.spacing, strict=True)), tuple(reversed(counts)))


def _velocities(volumes: UffVolumes, plan: TrackingPlan, described: str, path: str) -> Recording:
    """A recording of real volumes with a channel for each component, m/s; what is not finite has weight 0."""
    values, grid = volumes.values, volumes.grid
    frames, channels = values.shape[:2]
    if channels != grid.dimension:
        raise ValueError(
            f"{path}: {channels} channels of real values are no velocity in {grid.dimension} dimensions; give IQ, or a "
            "channel for each component"
        )
    if frames > 1 and volumes.frame_rate is None:
        raise ValueError(f"{path}: states no frame_rate for its {frames} frames; write it into the file")
    known = np.isfinite(values).all(axis=1)
    return Recording(
        np.arange(frames) / (volumes.frame_rate or 1.0),
        grid,
        np.where(known[:, None], values, 0).astype(np.float32),
        np.ones(known.shape, bool),
        None,
        plan.rho,
        plan.mu,
        weight=None if known.all() else known.astype(np.float32),
        description=described,
    )
