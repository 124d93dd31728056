"""Quantities of a flow as a JSON document, a CSV and a table: of an analysis, of its members, of a truth."""

from __future__ import annotations

import argparse
import csv
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import geometry
from torchsph.evaluation.frames import matching_frames
from torchsph.evaluation.metrics import filled_velocity, gaps
from torchsph.haemodynamics.domain import FlowDomain
from torchsph.haemodynamics.quantities import Catalogue, catalogue, flow_quantities
from torchsph.haemodynamics.uncertainty import Summary, coverage
from torchsph.methods.members.quantities import MemberCurves

from .outputs import write_json

__all__ = ["CAUTION", "QuantityTables", "methods_read_out", "plain_curves"]

Curves = dict[str, NDArray[np.float64]]

CAUTION = (
    "At 1 mm and 10 ms do not believe as they stand: wall shear stress, energy loss and vorticity (too small in smooth "
    "fields, too large in raw ones), helicity; kinetic energy is too small by about an eighth. Members' bands count "
    "what is finer than the measurement shows; of helicity, force and pressure they hold three in four. For research, "
    "not for clinical use."
)

PLANE_CAUTION = (
    "Of a plane, per metre of depth; the energy loss is that of the shear within the plane alone. Left out, because "
    "they need the flow in space: volumes and fractions of them, forces, helicity, vortex rings, transit of blood"
)

CUT_CAUTION = (
    ", and the pressure (from a plane that blood passes through, a third of its difference is wrong). Flows through "
    "openings come out at half of the true ones in smooth fields"
)


def plain_curves(recording: geometry.Recording) -> Curves:
    """The curves of one recording alone; the variance that an analysis claims is added to its kinetic energy."""
    sigma = recording.sigma if recording.weight is None else None  # of a measurement it is noise, not missing energy
    missing = gaps(recording)
    if missing.any():
        part = f"{100 * missing.sum() / np.asarray(recording.mask, bool).sum():.3g} % of the nodes in the blood"
        warnings.warn(
            f"{part} carry no value and count as at rest, so that energies are too small; smooth or assimilate first",
            stacklevel=2,
        )
    return flow_quantities(FlowDomain.from_recording(recording), filled_velocity(recording), sigma=sigma)


@dataclass(frozen=True)
class QuantityTables:
    """Curves and numbers of a beat, and their bands where there are members.

    Attributes:
        time: (T,), s.
        kind: which quantities there are.
        curves: by their source ("analysis", "truth"), then by the names of the quantities, (T,).
        bands: of the members, by the same names; none without members.
        beat_bands: of the numbers of the beat.
    """

    time: NDArray[np.float64]
    kind: Catalogue
    curves: dict[str, Curves]
    bands: dict[str, Summary] = field(default_factory=dict)
    beat_bands: dict[str, Summary] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        recording: geometry.Recording,
        members: MemberCurves | None = None,
        truth: geometry.Recording | None = None,
    ) -> QuantityTables:
        """Of an analysis, of its members where they have been read out, and of the truth's frames at its times."""
        kind = catalogue(recording.dimension, recording.cut)
        if members is None:
            made = cls(recording.time, kind, {"analysis": plain_curves(recording)})
        else:
            # what is quadratic in the velocity is too small in the analysis itself: its best value is the members' mean
            made = cls(recording.time, kind, {"analysis": members.estimate}, members.bands(), members.beat_bands())
        if truth is not None:
            made.compare(truth)
        return made

    def compare(self, truth: geometry.Recording) -> None:
        """Add the truth's frames at the analysis's times.

        Raises:
            ValueError: it is of another kind, or has no frame at one of them.
        """
        if catalogue(truth.dimension, truth.cut) != self.kind:
            raise ValueError("the truth and the analysis must both be of space, of a plane flow, or of a cut plane")
        self.curves["truth"] = plain_curves(truth.select(matching_frames(self.time, truth.time, "the truth")))

    @property
    def beat(self) -> dict[str, Curves]:
        """Numbers of the beat by their source."""
        return {name: self.kind.beat(self.time, curves) for name, curves in self.curves.items()}

    def document(self, config: Mapping[str, Any]) -> dict[str, Any]:
        """The content of `quantities.json`."""
        members: dict[str, Any] = {}
        if self.bands:
            members["members"] = {
                "curves": {name: band._asdict() for name, band in self.bands.items()},
                "beat": {name: band._asdict() for name, band in self.beat_bands.items()},
            }
            if "truth" in self.curves:
                members["members"]["coverage"] = self.coverage()
        return {
            "time": self.time,
            "units": {**self.kind.units, **self.kind.beat_units},
            "curves": self.curves,
            "beat": self.beat,
            **members,
            "caution": self.caution,
            "config": dict(config),
        }

    @property
    def caution(self) -> str:
        """What not to believe, and what is left out."""
        if "volume" in self.kind.units:
            return CAUTION
        pressed = "pressure_difference" in self.kind.units
        return f"{PLANE_CAUTION}{'' if pressed else CUT_CAUTION}. {CAUTION}"

    def coverage(self) -> dict[str, float]:
        """Share of the truth's frames inside the members' band, by quantity."""
        return {name: coverage(band, self.curves["truth"][name]) for name, band in self.bands.items()}

    def write(self, folder: Path, config: Mapping[str, Any]) -> None:
        """`quantities.json` and `quantities.csv`."""
        write_json(folder / "quantities.json", self.document(config))
        columns = [
            (f"{source} {name}", name, self.curves[source][name]) for source in self.curves for name in self.kind.units
        ]
        for name, band in self.bands.items():
            columns += [(f"members {name} {part}", name, values) for part, values in band._asdict().items()]
        with (folder / "quantities.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["time [s]", *(f"{label} [{self.kind.units[name]}]" for label, name, _ in columns)])
            for frame, t in enumerate(self.time):
                writer.writerow([f"{t:.9g}", *(f"{values[frame]:.9g}" for _, _, values in columns)])

    def table(self) -> list[list[str]]:
        """RMS over time of every curve, then the numbers of the beat; with bands and errors where they are known."""
        compared, banded = "truth" in self.curves, bool(self.bands)
        heads = ["quantity", "unit", "analysis", *(["members", "+-"] if banded else [])]
        rows = [heads + (["truth", "error"] if compared else []) + (["in band"] if compared and banded else [])]
        inside = self.coverage() if compared and banded else {}
        for name, unit in self.kind.units.items():
            row = [f"{name} (RMS)", unit, _number(_rms(self.curves["analysis"][name]))]
            best = self.curves["analysis"][name]
            if banded:
                best = self.bands[name].mean
                row += [_number(_rms(best)), _number(_rms(self.bands[name].deviation), 2)]
            if compared:
                true = self.curves["truth"][name]
                row += [_number(_rms(true)), f"{_rms(best - true) / _rms(true):.3f}" if _rms(true) > 0 else "-"]
            rows.append(row + ([f"{inside[name]:.2f}"] if inside else []))
        return rows + self._beat_rows(compared, banded)

    def _beat_rows(self, compared: bool, banded: bool) -> list[list[str]]:
        rows, beat = [], self.beat
        for name, unit in self.kind.beat_units.items():
            best = float(beat["analysis"][name])
            row = [name, unit, _number(best)]
            if banded:
                band = self.beat_bands[name]
                best = float(band.mean)
                row += [_number(best), _number(float(band.deviation), 2)]
            if compared:
                true = float(beat["truth"][name])
                row += [_number(true), f"{best - true:+.3g}" if np.isfinite(best - true) else "-"]
                if banded:
                    row.append("yes" if band.low <= true <= band.high else "no" if np.isfinite(true) else "-")
            rows.append(row)
        return rows

    def lines(self) -> list[str]:
        """The table as lines of text, with the caution below."""
        rows = self.table()
        text = [
            "  ".join(cell.ljust(34) if n == 0 else cell.rjust(10) for n, cell in enumerate(row)).rstrip()
            for row in rows
        ]
        return [*text, self.caution]


def methods_read_out(args: argparse.Namespace, methods: Sequence[str], measured: geometry.Recording) -> tuple[str, ...]:
    """The methods whose members are read out, as the options of a run ask for it.

    Raises:
        ValueError: options that cannot be together, or a recording without walls whose quantities are asked for.
    """
    if args.keep_members and ("ensemble" not in methods or args.lag is not None):
        raise ValueError("--keep-members: only the ensemble has members, and with --lag they change after their time")
    if args.quantities and args.no_quantities:
        raise ValueError("--quantities and --no-quantities cannot be together")
    if args.quantities and measured.wall is None:
        raise ValueError("--quantities: those of a whole flow need a recording with walls (/wall)")
    if args.no_quantities or measured.wall is None:
        return ()
    if "ensemble" in methods:
        return ("ensemble",) if args.lag is None else ()
    return ("spline",) if args.quantities and methods[0] == "spline" else ()


def _rms(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else float("nan")


def _number(value: float, digits: int = 4) -> str:
    return f"{value:.{digits}g}" if np.isfinite(value) else "-"
