"""From a lab's files to a recording: read, placed, put in SI units, walled and checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from geometry.arguments import checked
from geometry.grids.grid import Grid
from geometry.recordings.read import read_recording
from geometry.recordings.recording import Recording, Wall
from geometry.recordings.units import factor
from geometry.surfaces.files import holds_surface

from .assemble import Fields
from .displacement import MotionOptions
from .field_map import FieldMap
from .own.files import own_recording
from .readers.hdf5 import text
from .series import read_fields
from .source import FormatError, refuse_streams, understood
from .walls import inside_at, wall_by_displacements, wall_from_files, wall_from_mask

ADDED = ("nyquist", "cut", "period")  # what is added to a recording that there is


@dataclass(frozen=True)
class WallOptions:
    """Where the wall comes from.

    Attributes:
        files: surfaces, one, or one for each frame in order of time; none: a wall around the mask.
        unit: of the files, a name or a number of metres.
        openings: how many of the longest holes of the files are orifices, regions 1, 2, ...
        unite: bodies that overlap become one.
        sheet: of a wall of finite thickness, `inner` is the blood's surface; `all` if the blood is what it encloses.
        smoothing: passes of Taubin's filter over a wall from a mask.
        motion: displacements by which the one surface moves.
    """

    files: tuple[str, ...] = ()
    unit: str = ""
    openings: int = 0
    unite: bool = False
    smoothing: int = 0
    motion: MotionOptions = MotionOptions()
    sheet: str = ""

    def scale(self, said: FieldMap) -> float:
        """Metres per unit of the files; that of the fields where the wall's is not said."""
        if self.unit:
            return factor(self.unit, "length")
        return said.unit("length") or 1.0


@dataclass(frozen=True)
class _Constants:
    """kg/m^3, Pa s and s of the recording to be made."""

    rho: float
    mu: float
    period: float


@dataclass(frozen=True)
class Converted:
    """A recording, and what its user should know of how it was made."""

    recording: Recording
    notes: tuple[str, ...] = ()


@checked
def convert(
    inputs: Sequence[str | Path],
    said: FieldMap | None = None,
    *,
    format: str = "",
    wall: WallOptions | None = None,
    rho: float = 1060.0,
    mu: float = 0.004,
    description: str = "",
) -> Converted:
    """A recording from files of velocity, of walls, or both.

    Args:
        inputs: files of one velocity series (arrays spread over several files, or a file for each frame), or
            surfaces alone, whose inside then becomes a recording in which nothing was measured.
        said: what the files do not say.
        format: name of the format, else the ends of the names tell.
        wall: where the wall comes from.
        rho: kg/m^3.
        mu: Pa s.
        description: of the recording.

    Raises:
        FileNotFoundError: a file is not there.
        FormatError: a file cannot be understood; the text says what is missing.
        RecordingError: the result breaks a rule of the recording file.
    """
    said, wall = said or FieldMap(), wall or WallOptions()
    paths = [Path(name) for name in inputs]
    if not paths:
        raise FormatError("convert: no file is named")
    every = [*paths, *map(Path, (*wall.files, *wall.motion.files))]
    missing = [path for path in every if not path.exists()]
    if missing:
        raise FileNotFoundError(f"{missing[0]}: there is no such file")
    refuse_streams(every)
    about = _Constants(rho, mu, said.period)
    text_of = description or f"converted from {paths[0].name}" + (
        f" and {len(paths) - 1} more" if len(paths) > 1 else ""
    )
    with understood(paths[0]):
        own = _own(paths, said, wall, description) if not format else None
        if own is not None:
            return own
        if not format and all(path.is_file() and holds_surface(path) for path in paths):
            return _walls_alone(paths, said, wall, about, text_of)
        return _walled(read_fields(paths, said, format), said, wall, about, text_of)


def _own(paths: Sequence[Path], said: FieldMap, wall: WallOptions, description: str) -> Converted | None:
    """A recording's file, or what `export` made of one, with what may be added to it; None for any other file."""
    added = {name: getattr(said, name) for name in ADDED if getattr(said, name) != getattr(FieldMap(), name)}
    plain = replace(said, **{name: getattr(FieldMap(), name) for name in ADDED}) == FieldMap() and wall == WallOptions()
    is_recording = len(paths) == 1 and _is_recording(paths[0])
    if is_recording and not plain:
        raise FormatError(
            f"{paths[0]}: is a recording already, in SI units; of the options of arrays, units and walls only "
            "--nyquist, --cut and --period go with it: leave the others out"
        )
    if not plain:
        return None
    recording = read_recording(paths[0]) if is_recording else own_recording(paths)
    if recording is None:
        return None
    if said.cut and recording.dimension == 3:
        raise FormatError(f"{paths[0]}: is a volume, and --cut is for planes that are cut out of one; leave it out")
    if "nyquist" in added:
        added["nyquist"] = np.full(recording.frames, added["nyquist"])
    if description:
        added["description"] = description
    notes = () if is_recording else (f"{paths[0].name} is an export of a recording, taken as it was",)
    return Converted(replace(recording, **added) if added else recording, notes)


def _is_recording(path: Path) -> bool:
    if not path.is_file() or not h5py.is_hdf5(path):
        return False
    with h5py.File(path, "r") as file:
        return text(file.attrs.get("format", "")) == "recording"


def _walled(fields: Fields, said: FieldMap, options: WallOptions, about: _Constants, description: str) -> Converted:
    """A recording of the fields between a wall from files, or one around the mask."""
    notes, grid, velocity, mask = list(fields.notes), fields.grid, fields.velocity, fields.mask
    known = np.isfinite(velocity).all(axis=1)
    wall = None
    if options.motion.files and not options.files:
        raise FormatError(f"{options.motion.files[0]}: moves a wall: name its surface (--wall)")
    if options.files:
        files = [Path(name) for name in options.files]
        turn = None if (fields.turn == np.eye(grid.dimension)).all() else fields.turn
        wall, _ = _wall(files, said, options, fields.time, about.period, turn)
        if wall.moves and len(wall.vertices) != len(fields.time):
            raise FormatError(f"{files[0]}: {len(files)} walls for {len(fields.time)} frames of velocity")
    if mask is None and wall is not None:
        mask = _inside(wall, len(fields.time), grid)
        notes.append("no mask is named: the inside of the wall is taken")
    elif mask is None:
        moving = np.zeros(grid.shape, bool)
        for seen, field in zip(known, velocity, strict=True):
            moving |= seen & (field != 0).any(axis=0)
        mask = np.broadcast_to(moving, known.shape)
        notes.append("no mask is named: nodes that ever move are taken as blood")
    if wall is None:
        wall = wall_from_mask(mask, grid, smoothing=options.smoothing)
        labels = sorted(set(np.unique(wall.region).tolist()) - {0})
        notes.append(f"wall at rest around the mask, openings where the grid cuts it: regions {labels or 'none'}")
        kept = mask & inside_at(wall, 0, grid)
        if kept.sum() < mask.sum():
            notes.append(
                f"{int(mask.sum() - kept.sum())} of {int(mask.sum())} nodes of the mask lie apart and are left out"
            )
        mask = kept
    weight = fields.weight
    unknown = mask & ~known
    if unknown.any():
        weight = np.where(known, np.float32(1) if weight is None else weight, np.float32(0))
        notes.append(f"{int(unknown.sum())} nodes in the mask have no value: weight 0")
    recording = Recording(
        fields.time,
        grid,
        velocity,
        mask,
        wall,
        description=description + "".join(f"; {note}" for note in fields.notes),
        weight=weight,
        sigma=fields.sigma,
        cut=said.cut,
        nyquist=None if said.nyquist is None else np.full(len(fields.time), said.nyquist),
        rho=about.rho,
        mu=about.mu,
        period=about.period,
    )
    return Converted(recording, tuple(notes))


def _wall(
    files: Sequence[Path],
    said: FieldMap,
    options: WallOptions,
    time: np.ndarray | None,
    period: float,
    turn: np.ndarray | None,
) -> tuple[Wall, np.ndarray | None]:
    """The wall of files, at the frames of the velocity where it moves, and the times of its own motion, if any."""
    scale, openings, unite, sheet = options.scale(said), options.openings, options.unite, options.sheet
    if not options.motion.files:
        return wall_from_files(files, scale, openings=openings, unite=unite, sheet=sheet, turn=turn), None
    if len(files) > 1:
        raise FormatError(f"{files[1]}: a wall that moves by displacements has one surface; name the first alone")
    return wall_by_displacements(
        files[0],
        options.motion,
        scale,
        time=time,
        period=period,
        openings=openings,
        unite=unite,
        sheet=sheet,
        turn=turn,
    )


def _inside(wall: Wall, frames: int, grid: Grid) -> np.ndarray:
    """The nodes inside a wall, (T, *grid)."""
    if not wall.moves:
        return np.broadcast_to(inside_at(wall, 0, grid), (frames, *grid.shape))
    mask = np.empty((frames, *grid.shape), bool)
    for frame in range(frames):
        mask[frame] = inside_at(wall, frame, grid)
    return mask


def _walls_alone(
    paths: Sequence[Path], said: FieldMap, options: WallOptions, about: _Constants, description: str
) -> Converted:
    """A recording of a wall in which nothing was measured: velocity 0 at weight 0."""
    if said.grid_spacing is None:
        raise FormatError(
            f"{paths[0]}: on which grid is its inside wanted? Say its spacing in m (--grid-spacing 0.002)"
        )
    if options.files:
        raise FormatError(f"{paths[0]}: is a surface itself; name files of velocity before --wall")
    wall, stated = _wall(paths, said, options, None, said.period, None)
    count = len(wall.vertices) if wall.moves else 1
    if count > 1 and stated is None and said.interval is None and not said.period:
        raise FormatError(f"{paths[0]}: when were the {count} walls? Say it (--interval S or --period S)")
    step = said.interval if said.interval is not None else said.period / count
    time = step * np.arange(count) if said.interval is not None or stated is None else stated
    points = wall.vertices.reshape(-1, 3)
    grid = Grid.covering(tuple(points.min(axis=0)), tuple(points.max(axis=0)), said.grid_spacing)
    mask = _inside(wall, count, grid)
    recording = Recording(
        time,
        grid,
        np.zeros((count, 3, *grid.shape), np.float32),
        mask,
        wall,
        description=f"{description}; walls alone, nothing measured",
        weight=np.zeros(mask.shape),
        rho=about.rho,
        mu=about.mu,
        period=about.period,
    )
    volume = [wall.at(frame).volume for frame in range(count)] if wall.moves else [wall.at(0).volume]
    return Converted(recording, (f"walls alone, {1e6 * min(volume):.4g} to {1e6 * max(volume):.4g} ml; weight 0",))
