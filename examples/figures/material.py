"""What the figures are made of: options, the phantom beside the checkout or the sample that ships, shared analyses."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np

import geometry
import regularize
import torchsph as ts
from torchsph.data import sample_measurement, sample_truth
from torchsph.methods.measurement.prepared import PreparedMeasurement

from ..provenance import ROOT, code_hash

Part = TypeVar("Part")
PHANTOM, MEASUREMENTS = "lv_phantom_a.h5", {"measured": "lv_phantom_a_measured.h5", "noisy": "lv_phantom_a_noisy.h5"}
ROOMS = (
    "geometry",
    "regularize",
    "torchsph/simulator",
    "torchsph/pairs",
    "torchsph/methods",
)  # that analyses run through
FILLING = 0.26, 0.32  # s, what the fast variants take of the sample: the early wave


@dataclass(frozen=True)
class Material:
    """What a script is asked for, and its data.

    Args:
        fast: coarse and short: seconds instead of minutes, on the sample that ships with torchsph.
        seed: of everything random.
        data: folder of the phantom, for what is not fast.
        kept: folder for analyses that several figures share, or None.
    """

    fast: bool = False
    seed: int = 0
    data: Path = ROOT.parent / "shared" / "data"
    kept: Path | None = None
    _now: list[str] = field(default_factory=list, init=False, repr=False, compare=False)
    _made: dict[str, geometry.Recording] = field(default_factory=dict, init=False, repr=False, compare=False)

    def begin(self, figure: str, code: str) -> None:
        """From now on parts belong to a figure, made by code of that hash."""
        self._now[:] = [f"{figure}-{self.seed}-{code}"]

    def part(self, key: str, compute: Callable[[], Part]) -> Part:
        """A part of a figure that JSON can hold, kept as a file: a figure that was cut off goes on from there."""
        if self.kept is None or self.fast or not self._now:
            return compute()
        file = self.kept / f"{self._now[0]}-{re.sub(r'[^A-Za-z0-9.]+', '_', key)}.json"
        if not file.is_file():
            found = compute()
            file.parent.mkdir(parents=True, exist_ok=True)
            half = file.with_suffix(".half")
            half.write_text(json.dumps(found), encoding="utf-8")
            half.replace(file)
        read: Part = json.loads(file.read_text(encoding="utf-8"))
        return read

    def settings(self, **more: object) -> dict[str, object]:
        """What goes into a figure's JSON."""
        source = "the sample recording of torchsph" if self.fast else PHANTOM
        return {"fast": self.fast, "seed": self.seed, "recording": source, **more}

    @cached_property
    def truth(self) -> geometry.Recording:
        """Frames of 5 ms of a CFD ventricle.

        Raises:
            FileNotFoundError: the phantom is not beside the checkout.
        """
        if not self.fast:
            return geometry.read_recording(str(self._file(PHANTOM)))
        whole = geometry.read_recording(str(sample_truth()))
        return whole.select((whole.time > FILLING[0] - 1e-6) & (whole.time < FILLING[1] + 1e-6))

    def scene(self, spacing: float) -> ts.Scene:
        """The truth's fluid, walls and valves for particles ``spacing`` (m) apart."""
        return ts.Scene.from_recording(self.truth, spacing, estimates=self._estimates)

    @cached_property
    def _estimates(self) -> geometry.Estimates:
        return geometry.estimated(self.truth)

    @cached_property
    def measured(self) -> geometry.Recording:
        """What a speckle tracker would report of it, frames of 10 ms; every other node of three of them if fast."""
        if not self.fast:
            return geometry.read_recording(str(self._file(MEASUREMENTS["measured"])))
        whole = geometry.read_recording(str(sample_measurement()))
        few = whole.select((whole.time > FILLING[0] + 0.02 - 1e-6) & (whole.time < FILLING[0] + 0.05 - 1e-6))
        return coarser(few, 2)

    @cached_property
    def true_frames(self) -> geometry.Recording:
        """The truth at the measurement's times, on its grid."""
        there = self.truth.select(np.isin(np.rint(1e5 * self.truth.time), np.rint(1e5 * self.measured.time)))
        return coarser(there, 2) if self.fast else there

    def frames_every(self, interval: float, count: int) -> list[int]:
        """``count`` frames of the truth ``interval`` (s) apart, from the first one on."""
        wanted = self.truth.time[0] + interval * np.arange(count)
        return sorted({int(np.abs(self.truth.time - time).argmin()) for time in wanted})

    def analysis(self, method: str) -> geometry.Recording:
        """The measurement as a method leaves it: "spline, thesis", "sph, thesis", "spline, default", ...

        Raises:
            ValueError: an unknown method.
        """
        if method in self._made:
            return self._made[method]
        file = None
        if self.kept is not None and not self.fast:
            name = f"{method.replace(', ', '-')}-{self.seed}-{code_hash(ROOMS)}.h5"
            file = self.kept / name
        if file is not None and file.is_file():
            return self._made.setdefault(method, geometry.read_recording(str(file)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the thesis preset loses volume; its numbers say how much
            found = self._analysed(method, None if file is None else file.with_suffix(".pt"))
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            geometry.write_recording(str(file), found)
        return self._made.setdefault(method, found)

    def _analysed(self, method: str, checkpoint: Path | None) -> geometry.Recording:
        """The command line's own settings, but for the thesis's; a run that was cut off goes on from ``checkpoint``."""
        measured = self.measured
        spacing = (2.5 if self.fast else 2.0) * 1e-3
        if checkpoint is not None:
            checkpoint.parent.mkdir(parents=True, exist_ok=True)
        if method == "spline, thesis":
            nodes = (12, 8, 8) if self.fast else (32, 16, 16)
            return ts.smooth(measured, regularize.Smoother.preset("thesis", nodes=nodes))
        if method == "spline, default":
            return ts.smooth(measured)
        if method == "sph, thesis":
            return self._filtered_as_in_the_thesis(measured.frames, spacing)
        if method == "ensemble, default":
            few = {"spacing": 4e-3, "members": 4} if self.fast else {}
            kept = {} if checkpoint is None else {"checkpoints": checkpoint, "resume": True}
            return ts.run_methods(measured, ("ensemble",), seed=self.seed, **few, **kept)["ensemble"].recording
        raise ValueError(f"unknown method '{method}'")

    def _filtered_as_in_the_thesis(self, frames: int, spacing: float) -> geometry.Recording:
        """By the thesis's preset, as many frames as it lives through: over a whole beat it loses too much volume."""
        measured = self.measured.select(slice(0, frames))
        model = ts.Simulator(ts.Scene.from_recording(measured, spacing), ts.preset("thesis"))
        # its splines tell how noisy the measurement is
        smoothed = self.analysis("spline, default").select(slice(0, frames))
        try:
            return ts.filter_sph(PreparedMeasurement(measured, smoothed=smoothed), model, seed=self.seed).recording
        except ts.NumericalFailure as failure:
            ended = re.search(r"at about ([0-9.e+-]+) s", str(failure))
            lived = 0 if ended is None else int((measured.time < float(ended[1])).sum()) - 1
            if not 0 < lived < frames:
                raise
            return self._filtered_as_in_the_thesis(lived, spacing)

    def _file(self, name: str) -> Path:
        file = self.data / name
        if not file.is_file():
            raise FileNotFoundError(f"{file}: the phantom is not there; name its folder by --data, or take --fast")
        return file


def coarser(recording: geometry.Recording, every: int) -> geometry.Recording:
    """Every so manieth node of a recording."""
    few = (..., *(slice(None, None, every),) * recording.dimension)
    grid = recording.grid
    shape = tuple(-(-n // every) for n in grid.shape)
    fields = {name: getattr(recording, name) for name in ("velocity", "mask", "weight", "sigma", "pressure")}
    return replace(
        recording,
        grid=geometry.Grid(grid.origin, tuple(every * h for h in grid.spacing), shape),
        **{name: np.asarray(field)[few] for name, field in fields.items() if field is not None},
    )


def per_frame_error(found: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """RMS of the error and of the truth per frame, (T,) each, m/s, from (T, 3, *shape) over masks (T, *shape)."""
    size = mask.reshape(len(mask), -1).sum(1)
    wrong, right = (
        np.sqrt((np.where(mask[:, None], np.nan_to_num(field), 0.0) ** 2).reshape(len(mask), -1).sum(1) / size)
        for field in (np.nan_to_num(found) - np.nan_to_num(truth), truth)
    )
    return wrong, right
