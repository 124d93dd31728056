"""The wall against the mask, the volumes, the fluxes and itself."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from geometry.surfaces.overlap import refuse_overlaps
from geometry.surfaces.shells import shell_of
from geometry.surfaces.surface import SurfaceError
from geometry.surfaces.winding import grid_winding

from .finding import Finding, sampled
from .recording import Recording

FRAMES = 3
OUTSIDE = 0.1  # share of mask nodes outside the wall that is told: voxels along a wall may lie half outside
CONTRADICTED = 0.5  # share above which mask and wall cannot belong together
EMPTY = 0.5  # share of the nodes inside the wall that are missing from the mask
OFF = 0.15  # relative difference of volumes: that of a coarse wall of triangles reaches a tenth
FLICKER = 1.2  # RMS of the steps' changes over that of the steps: 1.7 for pure noise, below .5 for motion


def bodies(recording: Recording) -> Iterator[Finding]:
    """Closed bodies of the wall that overlap are counted twice in its volume."""
    if recording.wall is None or recording.dimension != 3:
        return
    try:
        refuse_overlaps(recording.wall.at(0))
    except SurfaceError as fault:
        rule, _, cure = str(fault).partition("; ")
        yield Finding("/wall/faces", rule, cure, severe=True)


def shells(recording: Recording) -> Iterator[Finding]:
    """A wall of finite thickness encloses its own material, not the blood."""
    if recording.wall is None:
        return
    shell = shell_of(recording.wall.at(0))
    if shell is not None:
        rule = (
            f"is a wall of finite thickness: {1e6 * shell.material:.3g} ml of material around "
            f"{1e6 * shell.lumen:.3g} ml of room"
        )
        yield Finding("/wall/faces", rule, "if the blood is in that room, keep the inner sheet (convert --sheet inner)")


def mask_and_wall(recording: Recording) -> Iterator[Finding]:
    """The share of the mask outside the wall, and of the wall's inside that the mask leaves out."""
    wall, grid = recording.wall, recording.grid
    if wall is None:
        return
    outside = nodes = missing = inside = 0
    for frame in sampled(recording.frames, FRAMES):
        surface, mask = wall.at(frame), recording.mask[frame]
        within = grid_winding(grid, surface.vertices, surface.faces) > 0
        outside, nodes = outside + int((mask & ~within).sum()), nodes + int(mask.sum())
        missing, inside = missing + int((within & ~mask).sum()), inside + int(within.sum())
    if nodes and outside > OUTSIDE * nodes:
        rule = f"{100 * outside / nodes:.3g} % of the nodes in the mask lie outside the wall"
        severe = outside > CONTRADICTED * nodes
        shell = "; a wall of finite thickness is not the blood's surface: keep its inner sheet alone" if severe else ""
        yield Finding("/mask", rule, f"give mask and wall in the same coordinates and at the same times{shell}", severe)
    if inside and missing > EMPTY * inside:
        rule = f"leaves out {100 * missing / inside:.3g} % of the nodes inside the wall"
        yield Finding("/mask", rule, "where blood was not seen, keep the mask and give /weight 0")


def volumes(recording: Recording) -> Iterator[Finding]:
    """The volume stated against the one that the wall encloses."""
    if recording.wall is None or recording.volume is None:
        return
    enclosed = _enclosed(recording)
    off = np.abs(recording.volume - enclosed) / np.maximum(np.abs(enclosed), 1e-300)
    if off.max() > OFF:
        frame = int(off.argmax())
        rule = f"is {recording.volume[frame]:.4g} m3 at frame {frame}, where the wall encloses {enclosed[frame]:.4g} m3"
        yield Finding("/volume", rule, "give m3 (ml times 1e-6), or leave it out")


def fluxes(recording: Recording) -> Iterator[Finding]:
    """The fluxes stated against the change of the wall's volume."""
    if recording.wall is None or recording.flux_mitral is None or recording.flux_aortic is None or recording.frames < 4:
        return
    rate = np.gradient(_enclosed(recording), recording.time)
    flux = recording.flux_mitral + recording.flux_aortic
    size = float(np.sqrt(np.mean(rate**2)))
    misfit = float(np.sqrt(np.mean((flux - rate) ** 2)))
    if size > 0 and misfit > 0.5 * size:
        rule = f"the fluxes miss the change of the wall's volume (RMS {size:.2g} m3/s) by {misfit / size:.2g} of it"
        yield Finding("/flux/mitral", rule, "give m3/s, positive into the ventricle, at the times of the wall")


def wall_motion(recording: Recording) -> Iterator[Finding]:
    """A wall that flickers, and a stated velocity that is not the vertices'."""
    wall = recording.wall
    if wall is None or not wall.moves or recording.frames < 4:
        return
    steps = np.diff(wall.vertices, axis=0)
    size = float(np.sqrt(np.mean(steps**2)))
    change = float(np.sqrt(np.mean(np.diff(steps, axis=0) ** 2)))
    if size > 1e-6 and change > FLICKER * size:
        rule = f"the wall flickers: its steps between frames (RMS {1e3 * size:.2g} mm) change by {1e3 * change:.2g} mm "
        yield Finding(
            "/wall/vertices", f"{rule}from one to the next", "smooth the wall over time before it moves the blood"
        )
    if wall.velocity is None or size == 0:
        return
    rate = np.gradient(wall.vertices, recording.time, axis=0)
    scale, stated = float(np.sqrt(np.mean(rate**2))), float(np.sqrt(np.mean(wall.velocity.astype(np.float64) ** 2)))
    misfit = float(np.sqrt(np.mean((wall.velocity - rate) ** 2)))
    if misfit > 0.7 * max(scale, stated):
        rule = f"(RMS {stated:.2g} m/s) is not how the vertices move (RMS {scale:.2g} m/s)"
        yield Finding("/wall/velocity", rule, "give m/s, or leave it out: it is then differenced from the vertices")


def _enclosed(recording: Recording) -> np.ndarray:
    """Volume inside the wall at each frame, m^3."""
    wall = recording.wall_for("the volume")
    first = wall.at(0).volume
    if not wall.moves:
        return np.full(recording.frames, first)
    return np.array([wall.at(frame).volume for frame in range(recording.frames)])
