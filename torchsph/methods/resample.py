"""A recording of another frame rate or grid, made of an analysis and its model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from tqdm import tqdm

import geometry
from geometry.arguments import checked, finite
from torchsph.simulator.simulator import Simulator
from torchsph.simulator.state.checks import SPACING

from .between_frames import BetweenFrames

FINEST = 4_000_000
"""Nodes of a grid: more are a slip in the spacing."""


def frame_times(time: np.ndarray, rate: float) -> np.ndarray:
    """Times from the first frame on, `rate` a second, as far as the last frame, s.

    Raises:
        ValueError: a rate that is not positive.
    """
    if not rate > 0:
        raise ValueError(f"a frame rate must be positive (frames a second), got {rate}")
    count = int(np.floor((time[-1] - time[0]) * rate * (1 + 1e-9))) + 1
    return np.minimum(time[0] + np.arange(count) / rate, time[-1])


@checked(times=finite(), spacing=SPACING)
def resample(
    recording: geometry.Recording,
    model: Simulator | None = None,
    *,
    times: ArrayLike | None = None,
    spacing: float | None = None,
    seed: int = 0,
    progress: bool = False,
) -> geometry.Recording:
    """The flow of a recording at other times or on a finer grid (`BetweenFrames`).

    Args:
        recording: an analysis, or any flow without gaps.
        model: simulator of its scene; None: straight lines between frames.
        times: s, increasing, within the frames; None: the frames' own.
        spacing: of the grid, m, along every axis; None: the recording's own grid. Detail below the recording's grid is
            the model's: its particles must be as fine.
        seed: of the particles.
        progress: show a bar.

    Returns:
        A recording with velocity, mask, walls, valves and, where the analysis claims one, its deviation. Pressure,
        fluxes and quality codes, which belong to frames, are left out.

    Raises:
        ValueError: a time outside the frames or not after its predecessor, or a spacing that cannot be.
    """
    wanted = np.asarray(recording.time if times is None else times, np.float64).reshape(-1)
    if len(wanted) == 0 or (np.diff(wanted) <= 0).any():
        raise ValueError("resample: times must increase, and be at least one")
    grid = recording.grid if spacing is None else _refined(recording.grid, spacing)
    flow = BetweenFrames(recording, model, seed=seed)
    bar = tqdm(flow.moments(wanted, grid), total=len(wanted), desc="resample", disable=None if progress else True)
    found = list(bar)
    claims = [one.sigma for one in found if one.sigma is not None]
    bare = replace(recording, pressure=None, volume=None, quality=None, weight=None, beam=None, sigma=None, fluxes=())
    bare = replace(bare, flux_mitral=None, flux_aortic=None, uncovered=None)
    return replace(
        bare,
        time=wanted,
        grid=grid,
        velocity=np.stack([one.velocity for one in found]),
        sigma=np.stack(claims) if claims else None,
        mask=np.stack([one.mask for one in found]),
        uncovered=np.array([one.uncovered for one in found], np.int64),
        wall=_wall(recording, flow.motion, wanted),
        valve_open=_nearest(recording, wanted),
        description=f"{recording.description}, resampled".removeprefix(", "),
    )


def _refined(grid: geometry.Grid, spacing: float) -> geometry.Grid:
    if not spacing > 0:
        raise ValueError(f"resample: the spacing must be positive (m), got {spacing}")
    nodes = np.prod([(end - start) / spacing + 1 for start, end in zip(grid.origin, grid.upper, strict=True)])
    if nodes > FINEST:
        raise ValueError(
            f"resample: a spacing of {spacing:g} m makes {nodes:.2g} nodes; it is in metres, 1 mm is 0.001"
        )
    return grid.refined(spacing)


def _wall(recording: geometry.Recording, motion: geometry.WallMotion | None, times: np.ndarray) -> geometry.Wall | None:
    if recording.wall is None or motion is None or not recording.wall.moves:
        return recording.wall
    sigma = recording.wall.sigma
    if sigma is not None and sigma.ndim == 2:
        sigma = np.stack([np.interp(times, recording.time, column) for column in sigma.T], axis=1)
    return replace(
        recording.wall,
        vertices=np.stack([motion.vertices(float(t)) for t in times]),
        velocity=np.stack([motion.velocity(float(t)) for t in times]),
        sigma=sigma,
    )


def _nearest(recording: geometry.Recording, times: np.ndarray) -> np.ndarray | None:
    if recording.valve_open is None:
        return None
    frames = np.abs(recording.time[None, :] - times[:, None]).argmin(1)
    return recording.valve_open[frames]
