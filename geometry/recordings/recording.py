"""A recording: velocity volumes on a regular grid over time, with the walls and valves around the blood.

Truths, measurements, forecasts and analyses are all recordings. In memory as in the file, grid arrays are
indexed `[time, component, z, y, x]`, components in the order x, y, z, all in SI units; a plane recording
drops the z axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any

import numpy as np

from geometry.arguments import checked, shown
from geometry.grids.grid import Grid
from geometry.surfaces.integers import narrowed
from geometry.surfaces.surface import Surface

from .errors import RecordingError
from .opening_flux import OpeningFlux, check_distinct

# Field of `Recording` (after a dot: of its wall), dataset, type in memory and in the file.
LAYOUT: tuple[tuple[str, str, type], ...] = (
    ("time", "/time", np.float64),
    ("velocity", "/velocity", np.float32),
    ("mask", "/mask", np.bool_),
    ("weight", "/weight", np.float32),
    ("sigma", "/sigma", np.float32),
    ("uncovered", "/uncovered", np.int64),
    ("quality", "/quality", np.uint8),
    ("beam", "/beam", np.float32),
    ("normal", "/normal", np.float32),
    ("nyquist", "/nyquist", np.float64),
    ("pressure", "/pressure", np.float32),
    ("pressure_sigma", "/pressure_sigma", np.float32),
    ("wall.vertices", "/wall/vertices", np.float64),
    ("wall.faces", "/wall/faces", np.int32),
    ("wall.region", "/wall/region", np.uint8),
    ("wall.velocity", "/wall/velocity", np.float32),
    ("wall.sigma", "/wall/sigma", np.float32),
    ("valve_intervals", "/valve/intervals", np.float64),
    ("valve_leak", "/valve/leak", np.float64),
    ("valve_open", "/valve_open", np.uint8),
    ("volume", "/volume", np.float64),
    ("flux_mitral", "/flux/mitral", np.float64),
    ("flux_aortic", "/flux/aortic", np.float64),
)
REQUIRED = ("/time", "/velocity", "/mask")
OF_A_WALL = ("/wall/vertices", "/wall/faces", "/wall/region")  # all of them, or no wall at all


# what `Recording.check` goes through: `rules` enters itself here, because it has to know recordings
RULES: list[Callable[[Recording, str], None]] = []


@dataclass(frozen=True, eq=False)
class Wall:
    """The closed surface around the blood at every frame, same faces throughout.

    Args:
        vertices: (T, nv, D) or, at rest, (nv, D), m.
        faces: (nf, D), vertex numbers, normals outwards.
        region: (nf,), 0 wall, 1 mitral inlet, 2 aortic outlet, further ones free.
        velocity: (T, nv, D), m/s, or None: it then follows from `vertices`.
        sigma: (T, nv) or (nv,), m, standard deviation of a vertex's place; None: nothing is known of it.
    """

    vertices: np.ndarray
    faces: np.ndarray
    region: np.ndarray
    velocity: np.ndarray | None = None
    sigma: np.ndarray | None = None

    def __post_init__(self) -> None:
        _coerce(self, "wall.")

    @property
    def moves(self) -> bool:
        """Whether there is one set of vertices for each frame."""
        return self.vertices.ndim == 3

    @checked
    def at(self, frame: int) -> Surface:
        """The surface at a frame."""
        return Surface(self.vertices[frame] if self.moves else self.vertices, self.faces, self.region)

    def select(self, frames: slice | Sequence[int] | np.ndarray) -> Wall:
        """The wall at some of the frames."""
        vertices = self.vertices[frames] if self.moves else self.vertices
        velocity = None if self.velocity is None else self.velocity[frames]
        sigma = self.sigma if self.sigma is None or self.sigma.ndim == 1 else self.sigma[frames]
        return replace(self, vertices=vertices, velocity=velocity, sigma=sigma)


@dataclass(frozen=True, eq=False)
class Recording:
    """Velocity volumes with their walls and valves; `None` stands for an optional dataset that is not there.

    Args:
        time: (T,), s, increasing.
        grid: where the values are.
        velocity: (T, D, *shape), m/s; 0 outside the mask.
        mask: (T, *shape) or, for every frame, (*shape), bool: inside the blood.
        wall: around the blood; None where nobody knows it (plane PIV, tracks on a grid).
        rho: kg/m^3.
        mu: Pa s.
        period: s, 0 = not periodic.
        description: in words.
        weight: (T, *shape), confidence in [0, 1]; the velocity may be NaN where it is 0.
        sigma: (T, D, *shape), m/s, standard deviation of each component.
        uncovered: (T,), nodes inside the mask for which a method has no value.
        quality: (T, *shape), codes of `Quality`: why an analysis is what it is at each node.
        beam: (T, D, *shape) or (D, *shape), unit vectors along which alone the velocity was measured.
        normal: (T, 3, *shape) or (3, *shape), unit vectors along which alone nothing was measured: planes in space.
        pressure: (T, *shape), Pa, gauge.
        pressure_sigma: (T, *shape), Pa, standard deviation of the pressure.
        valve_intervals: (n, 3), rows (region, opens, closes), s.
        valve_leak: (n, 2), rows (region, part of its area that stays open while it is shut).
        valve_open: (T, 2), regions 1 and 2 open at the frames; used where there are no intervals.
        volume: (T,), m^3.
        flux_mitral: (T,), m^3/s, positive into the ventricle.
        flux_aortic: (T,), m^3/s, likewise.
        fluxes: measured fluxes of regions, with their errors.
        nyquist: (T,), or (T, D) for each component of full vectors, m/s: what was measured is known modulo twice this.
        cut: of a plane, whether it is cut out of a flow in space, so that something passes through it.

    Raises:
        RecordingError: shapes that disagree; `geometry.check_recording` tests every rule of the format.
    """

    time: np.ndarray
    grid: Grid
    velocity: np.ndarray
    mask: np.ndarray
    wall: Wall | None
    rho: float
    mu: float
    period: float = 0.0
    description: str = ""
    weight: np.ndarray | None = None
    sigma: np.ndarray | None = None
    uncovered: np.ndarray | None = None
    quality: np.ndarray | None = None
    beam: np.ndarray | None = None
    pressure: np.ndarray | None = None
    pressure_sigma: np.ndarray | None = None
    valve_intervals: np.ndarray | None = None
    valve_leak: np.ndarray | None = None
    valve_open: np.ndarray | None = None
    volume: np.ndarray | None = None
    flux_mitral: np.ndarray | None = None
    flux_aortic: np.ndarray | None = None
    fluxes: tuple[OpeningFlux, ...] = ()
    nyquist: np.ndarray | None = None
    cut: bool = False
    normal: np.ndarray | None = None

    def __post_init__(self) -> None:
        _check_kinds(self)
        _coerce(self, "")
        if self.mask.shape == self.grid.shape:
            object.__setattr__(self, "mask", np.broadcast_to(self.mask, (len(self.time), *self.grid.shape)))
        check_distinct(self.fluxes)
        _check_shapes(self)

    @property
    def dimension(self) -> int:
        """2 for a plane recording, else 3."""
        return self.grid.dimension

    @property
    def frames(self) -> int:
        """Number of frames, T."""
        return len(self.time)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that are there, by the name of their dataset in the file."""
        found = {}
        for name, dataset, _ in LAYOUT:
            value = getattr(self.wall, name[5:], None) if name.startswith("wall.") else getattr(self, name)
            if value is not None:
                found[dataset] = value
        for flux in self.fluxes:
            found |= flux.arrays()
        return found

    @checked
    def check(self, source: str = "recording") -> None:
        """Test every rule of the format.

        Args:
            source: what the text of a fault opens with, as a file's name.

        Raises:
            RecordingError: the first rule that is broken.
        """
        for rules in RULES:
            rules(self, source)

    @checked
    def wall_for(self, purpose: str) -> Wall:
        """The wall, for what cannot do without one.

        Args:
            purpose: who asks, say "the simulator"; it opens the message.

        Raises:
            RecordingError: the recording has no wall.
        """
        if self.wall is None:
            rule = "is not in this recording; geometry.surface_from_mask makes a surface of the mask"
            raise RecordingError(purpose, "/wall", rule)
        return self.wall

    def select(self, frames: slice | Sequence[int] | np.ndarray) -> Recording:
        """Some of the frames, in increasing order of time: a slice, frame numbers or a bool for each frame.

        The period stays what it is: frames left out do not change the motion that they sample.

        Raises:
            ValueError: there are no such frames, or none is left.
        """
        chosen = _numbers(frames, self.frames)
        changes: dict[str, Any] = {"wall": None if self.wall is None else self.wall.select(chosen)}
        changes["fluxes"] = tuple(flux.select(chosen) for flux in self.fluxes)
        for name, _, _ in LAYOUT:
            value = None if name.startswith("wall.") else getattr(self, name)
            still = name in ("valve_intervals", "valve_leak") or (
                name in ("beam", "normal") and value is not None and value.ndim == self.dimension + 1
            )
            if value is not None and not still:
                changes[name] = value[chosen]
        return replace(self, **changes)

    @checked
    def with_velocity(
        self,
        velocity: np.ndarray,
        *,
        sigma: np.ndarray | None = None,
        uncovered: np.ndarray | None = None,
        quality: np.ndarray | None = None,
        description: str | None = None,
    ) -> Recording:
        """Another velocity (T, D, *shape), m/s, between the same walls: an analysis or a forecast.

        What belonged to the old velocity (weight, sigma, quality, beam, normal, nyquist, pressure, fluxes) is dropped.
        """
        gone: dict[str, Any] = dict.fromkeys(("weight", "beam", "normal", "nyquist", "pressure", "pressure_sigma"))
        gone |= dict.fromkeys(("flux_mitral", "flux_aortic"))
        text = self.description if description is None else description
        new: dict[str, Any] = {"velocity": velocity, "sigma": sigma, "uncovered": uncovered, "quality": quality}
        return replace(self, **new, description=text, fluxes=(), **gone)

    def valve_intervals_or_derived(self) -> np.ndarray:
        """Rows (region, opens, closes), `(n, 3)`, s: `/valve/intervals`, or else derived from `/valve_open`.

        A change seen between two frames took place midway between them; a valve that is open at the first
        frame opens at -inf, one open at the last frame closes at +inf, because the recording does not say
        when. No rows where the recording has neither.
        """
        if self.valve_intervals is not None:
            return self.valve_intervals
        if self.valve_open is None:
            return np.zeros((0, 3))
        edges = np.concatenate([[-np.inf], 0.5 * (self.time[1:] + self.time[:-1]), [np.inf]])
        rows = []
        for region in (1, 2):
            state = np.concatenate([[0], self.valve_open[:, region - 1].astype(np.int8), [0]])
            change = np.diff(state)
            for opens, closes in zip(np.flatnonzero(change == 1), np.flatnonzero(change == -1), strict=True):
                rows.append((region, edges[opens], edges[closes]))
        return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _check_kinds(recording: Recording) -> None:
    """Refuse what is no grid, wall, flux, text or number in the place of one; numbers become Python's."""
    kinds = (("grid", Grid), ("wall", Wall | None), ("description", str), ("fluxes", tuple), ("cut", bool))
    wrong = [name for name, kind in kinds if not isinstance(getattr(recording, name), kind)]
    if wrong or not all(isinstance(flux, OpeningFlux) for flux in recording.fluxes):
        name = wrong[0] if wrong else "fluxes"
        kind = "a tuple of OpeningFlux" if name == "fluxes" else f"a {dict(kinds)[name]}"
        raise TypeError(f"Recording: {name} must be {kind}, got {type(getattr(recording, name)).__name__}")
    for name in ("rho", "mu", "period"):
        value = getattr(recording, name)
        try:
            object.__setattr__(recording, name, float(value))
        except (TypeError, ValueError, OverflowError, RuntimeError):
            raise TypeError(f"Recording: {name} must be a number, got {shown(value)}") from None


def _coerce(instance: Wall | Recording, prefix: str) -> None:
    """Bring every array to its type; a recording keeps no reference to lists or other array types."""
    kinds = {name.removeprefix(prefix): kind for name, _, kind in LAYOUT if name.startswith(prefix)}
    datasets = {name.removeprefix(prefix): dataset for name, dataset, _ in LAYOUT if name.startswith(prefix)}
    for item in fields(instance):
        value = getattr(instance, item.name)
        if item.name in kinds and value is None and item.default is MISSING:
            raise RecordingError("recording", datasets[item.name], "is required, not None")
        if item.name in kinds and value is not None:
            try:
                array = narrowed(value, kinds[item.name])
            except ValueError as fault:
                raise RecordingError("recording", datasets[item.name], str(fault)) from fault
            object.__setattr__(instance, item.name, array)


def _numbers(frames: slice | Sequence[int] | np.ndarray, count: int) -> np.ndarray:
    """Frame numbers (n,) that a slice, numbers or bools stand for, of ``count`` frames."""
    if isinstance(frames, slice):
        return np.arange(count)[frames]
    asked = np.asarray(frames)
    numbers = asked.dtype.kind in "iu" and bool(((asked >= -count) & (asked < count)).all())
    if asked.ndim != 1 or not (numbers or (asked.dtype.kind == "b" and len(asked) == count)):
        what = f"{asked.dtype} of the shape {asked.shape}" if asked.dtype.kind not in "iu" else f"numbers {frames}"
        raise ValueError(f"frames must be a slice, numbers from 0 to {count - 1} or {count} bools, not {what}")
    return np.arange(count)[asked]


def _check_shapes(recording: Recording) -> None:
    """Ranks and sizes that must agree: time, grid, wall and valves against each other."""
    source, arrays = "recording", recording.arrays()
    if recording.time.ndim != 1 or recording.time.size == 0:
        raise RecordingError(source, "/time", f"must be (T,) with at least one frame, not {recording.time.shape}")
    for dataset, shapes in _allowed_shapes(recording).items():
        if dataset in arrays and arrays[dataset].shape not in shapes:
            wanted = " or ".join(str(shape) for shape in shapes)
            rule = f"has the shape {arrays[dataset].shape}, but others in the recording ask for {wanted}"
            raise RecordingError(source, dataset, rule)


def _allowed_shapes(recording: Recording) -> dict[str, tuple[tuple[int, ...], ...]]:
    """The shapes that each dataset may have, given the frames, the grid and the size of the wall."""
    frames, dimension, shape = recording.time.shape[0], recording.grid.dimension, recording.grid.shape
    intervals, leak = recording.valve_intervals, recording.valve_leak
    return {
        "/velocity": ((frames, dimension, *shape),),
        "/mask": ((frames, *shape),),
        "/weight": ((frames, *shape),),
        "/sigma": ((frames, dimension, *shape),),
        "/uncovered": ((frames,),),
        "/quality": ((frames, *shape),),
        "/beam": ((frames, dimension, *shape), (dimension, *shape)),
        "/normal": ((frames, 3, *shape), (3, *shape)),
        "/nyquist": ((frames,),) if recording.beam is not None else ((frames,), (frames, dimension)),
        "/pressure": ((frames, *shape),),
        "/pressure_sigma": ((frames, *shape),),
        **({} if recording.wall is None else _allowed_wall_shapes(recording.wall, frames, dimension)),
        "/valve/intervals": ((len(intervals) if intervals is not None and intervals.ndim else 0, 3),),
        "/valve/leak": ((len(leak) if leak is not None and leak.ndim else 0, 2),),
        "/valve_open": ((frames, 2),),
        "/volume": ((frames,),),
        "/flux/mitral": ((frames,),),
        "/flux/aortic": ((frames,),),
        **{dataset: ((frames,),) for flux in recording.fluxes for dataset in flux.arrays()},
    }


def _allowed_wall_shapes(wall: Wall, frames: int, dimension: int) -> dict[str, tuple[tuple[int, ...], ...]]:
    points = (wall.vertices.shape[-2] if wall.vertices.ndim in (2, 3) else 0, dimension)
    faces = wall.faces.shape[0] if wall.faces.ndim else 0
    return {
        "/wall/vertices": ((frames, *points), points),
        "/wall/faces": ((faces, dimension),),
        "/wall/region": ((faces,),),
        "/wall/velocity": ((frames, *points),),
        "/wall/sigma": ((frames, points[0]), points[:1]),
    }
