"""`torchsph info`: a recording in a few lines, or the pair kernels of this machine."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, TypedDict

import numpy as np
import torch

import geometry
from torchsph.evaluation import metrics

from ..arguments import number
from ..command import Command
from ..findings import tell_findings
from ..printing import print_table
from ..running.isolated import SECONDS_TO_READ, isolated, memory_to_read
from ..running.notes import LOGGER


class Looked(TypedDict):
    """What is printed of a file."""

    rows: list[list[str]]
    findings: list[str]


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", nargs="?", metavar="FILE")
    parser.add_argument("--backends", action="store_true", help="list the pair kernels of this machine")
    parser.add_argument("--isolated", action="store_true", help="read it in a process of its own, with limits")
    parser.add_argument(
        "--seconds",
        type=number(0, open_below=True),
        default=SECONDS_TO_READ,
        metavar="S",
        help="that --isolated allows (%(default)g)",
    )
    parser.add_argument("--strict", action="store_true", help="refuse whatever else is odd about the recording")


def info(args: argparse.Namespace) -> None:
    """`torchsph info`: a recording in a few lines, or the pair kernels of this machine."""
    if args.file is None and not args.backends:
        raise ValueError("info needs a FILE to look at, or --backends")
    if args.backends:
        from torchsph.pairs.registry import available_backends

        devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
        rows = [
            [one.name, device, "yes" if one.present else "no", one.reason]
            for device in devices
            for one in available_backends(device)
        ]
        print_table([["backend", "device", "present", "why"], *rows], text=True)
    if args.file is None:
        return
    if not args.isolated:
        _show(_looked_at(args.file, args.strict))
        return
    look = partial(_looked_at, args.file, args.strict)
    _show(isolated(look, args.file, seconds=args.seconds, memory=memory_to_read(args.file)))


def _looked_at(file: str, strict: bool) -> Looked:
    """The summary of a file, and what is odd about it; refused with `strict`."""
    recording = geometry.read_recording(file)
    found = [] if strict else [str(finding) for finding in geometry.findings(recording)]
    if strict:
        tell_findings(recording, file, strict=True)
    rows = summary_table(recording)
    made_by = geometry.read_provenance(file)
    if made_by is not None:
        rows.append(["made by", _maker(made_by)])
    return {"rows": rows + _memory_rows(recording), "findings": found}


def _show(found: Looked) -> None:
    print_table(found["rows"], text=True)
    for finding in found["findings"]:
        LOGGER.warning("%s", finding)


def _maker(made_by: Mapping[str, Any]) -> str:
    """Version, commit, command, method and seed of an attribute that may hold anything."""
    told = [f"torchsph {made_by.get('torchsph', '?')}"]
    told += [
        f"{name} {made_by[name]}" for name in ("commit", "command", "method", "seed") if made_by.get(name) is not None
    ]
    return ", ".join(told)


def _memory_rows(recording: geometry.Recording) -> list[list[str]]:
    """What the default run would take; nothing for what no method runs on."""
    from torchsph.methods import by_name  # long imports, which the list of backends has no need of
    from torchsph.methods.measurement.prepared import PreparedMeasurement
    from torchsph.methods.memory import free_memory

    try:
        methods = ("ensemble",) if recording.wall is not None else ("spline",)
        needed = by_name.predicted_memory(PreparedMeasurement(recording), methods).total
    except (ValueError, RuntimeError):
        return []
    free = free_memory()
    left = "" if free is None else f", {free / 1e9:.3g} GB are free"
    return [["memory", f"about {needed / 1e9:.2g} GB for {methods[0]} beside the program's own{left}"]]


def summary_table(recording: geometry.Recording) -> list[list[str]]:
    """What a recording holds, as rows of name and value."""
    time, grid = np.asarray(recording.time), recording.grid
    speed = np.linalg.norm(metrics.filled_velocity(recording), axis=1)[np.asarray(recording.mask, bool)]
    intervals = recording.valve_intervals_or_derived()
    optional = (
        "weight",
        "sigma",
        "uncovered",
        "quality",
        "beam",
        "normal",
        "nyquist",
        "pressure",
        "pressure_sigma",
        "volume",
        "flux_mitral",
        "flux_aortic",
        "valve_leak",
    )
    present = [name for name in optional if getattr(recording, name) is not None]
    present += [flux.dataset.strip("/") for flux in recording.fluxes]
    rows = [
        ["recording", "valid"],
        ["description", recording.description or "-"],
        ["dimension", "2, cut out of a flow in space" if recording.cut else str(recording.dimension)],
        ["frames", f"{len(time)}, {time[0]:g} to {time[-1]:g} s"],
        ["grid", f"{' x '.join(str(n) for n in reversed(grid.shape))} nodes, spacing {_mm(grid.spacing)} mm"],
        ["fluid", f"{recording.rho:g} kg/m3, {1e3 * recording.mu:g} mPa s"],
        ["mask", f"{len(speed) / len(time):.0f} nodes in the blood per frame"],
        ["speed", f"RMS {_rms(speed):.3g}, highest {speed.max(initial=0):.3g} m/s"],
        ["wall", _wall_text(recording.wall)],
        ["also holds", ", ".join(present) or "-"],
    ]
    for region, opening, closing in [] if intervals is None else intervals:
        rows.append([f"orifice {int(region)}", f"open {1e3 * opening:g} to {1e3 * closing:g} ms"])
    return rows


def _wall_text(wall: geometry.Wall | None) -> str:
    if wall is None:
        return "-"
    regions = {int(label): int(n) for label, n in zip(*np.unique(wall.region, return_counts=True), strict=True)}
    return f"{wall.vertices.shape[-2]} vertices, faces by region {regions}"


def _mm(lengths: Sequence[float]) -> str:
    return " x ".join(f"{1e3 * length:g}" for length in lengths)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values.astype(np.float64) ** 2))) if values.size else 0.0


COMMAND = Command("info", "Check a recording against the format and summarise it.", _arguments, info)
