"""What each command of the command line does: read, call the Python interface, write, print a small table."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

import geometry
from torchsph import __version__, data
from torchsph.assimilation import filter_figure
from torchsph.evaluation import figures as report
from torchsph.evaluation import metrics
from torchsph.methods import by_name as pipeline
from torchsph.methods.frame_splines import smooth as smooth_recording
from torchsph.methods.runtime import parallel

from .arguments import LEADS
from .convert import convert
from .export import export
from .findings import tell_findings
from .outputs import output_folder, staged, write_json
from .quantify import quantify

__all__ = ["COMMANDS"]

MEASURE_FLAGS = ("every", "lateral", "axial", "outliers", "snr", "prf", "packet", "clutter", "apex")


def assimilate(args: argparse.Namespace) -> None:
    """`torchsph assimilate`: every asked method on one measurement, scored, drawn and written.

    Under torchrun the processes share the ensemble's simulations; the first one writes and prints.
    """
    measured_path, truth_path, methods = _assimilate_inputs(args)
    folder, device = output_folder(args.out), parallel.own_device(_device(args.device))
    measured = geometry.read_recording(measured_path)
    also = [geometry.read_recording(path) for path in args.also]
    truth = None if truth_path is None else geometry.read_recording(truth_path)
    _check_spacing(args.spacing, measured)
    scores = {
        "raw": metrics.evaluate(measured, truth, measured)
    }  # first: a truth that does not fit must not cost a run
    saved = folder / "checkpoint.pt"
    with parallel.joined():
        results = pipeline.run_methods(
            measured,
            methods,
            preset=args.preset,
            spacing=args.spacing,
            members=args.members,
            lag=args.lag,
            also=also,
            truth=truth,
            checkpoints=saved,
            resume=args.resume,
            seed=args.seed,
            device=device,
            progress=parallel.is_lead(),
        )
    if not parallel.is_lead():
        return
    analyses = {name: result.recording for name, result in results.items()}
    scores |= {name: metrics.evaluate(recording, truth, measured) for name, recording in analyses.items()}
    seconds = {name: result.seconds for name, result in results.items()}
    chosen = pipeline.DEFAULT_METHOD if pipeline.DEFAULT_METHOD in methods else methods[0]
    config = _config(args, measured=measured_path, truth=truth_path, methods=methods, analysis=chosen)
    config["info"] = {name: result.info for name, result in results.items()}
    if truth is not None:
        claims = {name: metrics.spread_over_skill(recording, truth) for name, recording in analyses.items()}
        config["spread_over_skill"] = {name: claim.value for name, claim in claims.items() if claim is not None}
    with staged(folder) as scratch:
        for name, recording in analyses.items():
            geometry.write_recording(scratch / f"{name}.h5", recording)
        shutil.copyfile(scratch / f"{chosen}.h5", scratch / "analysis.h5")
        report.draw_report(scratch / "report.png", measured, analyses, scores, truth, seconds)
        if "ensemble" in results:
            filter_figure(results["ensemble"].info["filter"]).savefig(scratch / "filter.png", dpi=110)
        write_json(scratch / "metrics.json", metrics_document(measured, scores, seconds, config))
    saved.unlink(missing_ok=True)  # the run is complete: there is nothing to go on with
    _print_table(report.scores_table(scores, seconds))
    for words in results["ensemble"].info["filter"]["warnings"] if "ensemble" in results else ():
        _say(f"ensemble: {words}")
    _say(
        f"wrote {', '.join(f'{name}.h5' for name in analyses)}, analysis.h5 (= {chosen}.h5), report.png and "
        f"metrics.json to {folder}/"
    )


def _assimilate_inputs(args: argparse.Namespace) -> tuple[Path, Path | None, tuple[str, ...]]:
    if args.measurement is None:
        if args.truth is not None:
            raise ValueError("--truth needs MEASUREMENT.h5 (without it the sample runs, which has its own truth)")
        inputs = data.sample_measurement(), data.sample_truth()
        methods = args.method or tuple(pipeline.METHODS)
    else:
        inputs = Path(args.measurement), None if args.truth is None else Path(args.truth)
        methods = args.method or (pipeline.DEFAULT_METHOD,)
    unknown = [name for name in methods if name not in pipeline.METHODS]
    if unknown:
        raise ValueError(f"--method: unknown {', '.join(unknown)}; known are {', '.join(pipeline.METHODS)}")
    return *inputs, methods


def metrics_document(
    measured: geometry.Recording,
    scores: Mapping[str, metrics.Scores],
    seconds: Mapping[str, float],
    config: Mapping[str, Any],
) -> dict[str, Any]:
    """The content of `metrics.json`; the row `raw` is the measurement itself."""
    return {
        "methods": {name: {key: one.value for key, one in score.items()} for name, score in scores.items()},
        "per_frame": {
            name: {"time": measured.time} | {key: one.per_frame for key, one in score.items()}
            for name, score in scores.items()
        },
        "seconds": dict(seconds),
        "config": dict(config),
    }


def forecast(args: argparse.Namespace) -> None:
    """`torchsph forecast`: skill of the simulator against lead time, beside persistence."""
    folder, device = output_folder(args.out), _device(args.device)
    recording = _full_vectors(geometry.read_recording(args.recording), args.recording)
    _check_spacing(args.spacing, recording)
    leads = _leads_within(args.leads, recording, args.every)
    skill = pipeline.forecast_skill(
        recording,
        leads,
        every=args.every,
        preset=args.preset,
        spacing=args.spacing,
        device=device,
        save=args.save,
        progress=True,
        seed=args.seed,
    )
    config = _config(args, recording=args.recording, leads=leads) | dict(skill.config)
    with staged(folder) as scratch:
        for lead, saved in skill.recordings.items():
            geometry.write_recording(scratch / f"forecast_{1e3 * lead:g}ms.h5", saved)
        report.draw_forecast(scratch / "forecast.png", skill.leads)
        write_json(scratch / "metrics.json", {"leads": skill.leads, "seconds": skill.seconds, "config": config})
    rows = [["lead ms", "starts", "model", "persistence"]]
    for row in skill.leads:
        errors = [f"{row['nrmse'][name]:.3f}" for name in ("model", "persistence")]
        rows.append([f"{1e3 * row['lead']:g}", str(row["starts"]), *errors])
    _print_table(rows)
    _say(f"wrote forecast.png, metrics.json{' and the forecasts' if args.save else ''} to {folder}/")


def _leads_within(leads: Sequence[float] | None, recording: geometry.Recording, every: int) -> tuple[float, ...]:
    """The leads at which a start has a later frame to compare with; one that was asked for must have it."""
    time = np.asarray(recording.time)
    later = time[None, :] - time[::every, None]
    wanted = LEADS if leads is None else leads
    usable = tuple(lead for lead in wanted if (np.abs(later - lead) < metrics.SAME_TIME).any())
    missing = [f"{lead:g}" for lead in wanted if lead not in usable]
    possible = np.unique(later[later > metrics.SAME_TIME].round(9))
    if missing and (leads is not None or not usable):
        listed = ", ".join(f"{lead:g}" for lead in possible[:6]) + (", ..." if len(possible) > 6 else "")
        raise ValueError(
            f"--leads: no frame lies {', '.join(missing)} s after a start; possible are {listed or 'none'}"
        )
    if missing:
        _say(f"left out the leads {', '.join(missing)} s: no two frames are that far apart")
    return usable


def measure(args: argparse.Namespace) -> None:
    """`torchsph measure`: a measurement of a true recording, by a noise model or from simulated echoes."""
    from torchsph import ultrasound

    makers: dict[str, tuple[type, Callable[..., geometry.Recording]]] = {
        "noise": (ultrasound.NoiseModel, ultrasound.measure_noise),
        "speckle": (ultrasound.SpeckleOptions, partial(ultrasound.measure_speckle, progress=True)),
        "doppler": (ultrasound.DopplerOptions, partial(ultrasound.measure_doppler, progress=True)),
    }
    kind, make = makers[args.mode]
    path = _output_file(args.out)
    known = {one.name for one in fields(kind)}
    given = {name: value for name in MEASURE_FLAGS if (value := getattr(args, name)) is not None}
    foreign = [f"--{name}" for name in given if name not in known]
    if foreign:
        raise ValueError(f"{', '.join(foreign)}: means nothing with --mode {args.mode}")
    true = geometry.read_recording(args.true)
    measured = make(true, kind(**given), args.seed)
    geometry.write_recording(path, measured)
    if measured.beam is None:
        _print_table(report.scores_table({"raw": metrics.evaluate(measured, true)}, {}))
    _say(f"wrote {len(measured.time)} frames to {path}")


def smooth(args: argparse.Namespace) -> None:
    """`torchsph smooth`: a B-spline field for each frame."""
    path = _output_file(args.out)
    measured = _full_vectors(geometry.read_recording(args.measurement), args.measurement)
    smoothed = smooth_recording(measured, progress=True)
    geometry.write_recording(path, smoothed)
    scores = {name: metrics.evaluate(one, None, measured) for name, one in (("raw", measured), ("spline", smoothed))}
    _print_table(report.scores_table(scores, {}))
    _say(f"wrote {len(smoothed.time)} frames to {path}")


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
        _print_table([["backend", "device", "present", "why"], *rows], text=True)
    if args.file is not None:
        recording = geometry.read_recording(args.file)
        _print_table(summary_table(recording), text=True)
        tell_findings(recording, args.file, strict=args.strict)


def summary_table(recording: geometry.Recording) -> list[list[str]]:
    """What a recording holds, as rows of name and value."""
    time, grid = np.asarray(recording.time), recording.grid
    speed = np.linalg.norm(metrics.filled_velocity(recording), axis=1)[np.asarray(recording.mask, bool)]
    intervals = recording.valve_intervals_or_derived()
    optional = ("weight", "sigma", "uncovered", "beam", "pressure", "volume", "flux_mitral", "flux_aortic")
    present = [name for name in optional if getattr(recording, name) is not None]
    rows = [
        ["recording", "valid"],
        ["description", recording.description or "-"],
        ["dimension", str(recording.dimension)],
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


# --- helpers ---------------------------------------------------------------------------------------


def _wall_text(wall: geometry.Wall | None) -> str:
    if wall is None:
        return "-"
    regions = {int(label): int(n) for label, n in zip(*np.unique(wall.region, return_counts=True), strict=True)}
    return f"{wall.vertices.shape[-2]} vertices, faces by region {regions}"


def _mm(lengths: Sequence[float]) -> str:
    return " x ".join(f"{1e3 * length:g}" for length in lengths)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values.astype(np.float64) ** 2))) if values.size else 0.0


def _full_vectors(recording: geometry.Recording, path: str | Path) -> geometry.Recording:
    if recording.beam is not None:
        raise ValueError(
            f"{path}: /beam: holds one component along a beam (Doppler); the methods need full vectors, as "
            "speckle tracking or vector Doppler give them"
        )
    return recording


def _device(name: str) -> str:
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ValueError(f"--device: unknown device '{name}'; use cpu, cuda or cuda:N") from None
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f"--device: '{name}' is not supported; use cpu, cuda or cuda:N")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ValueError(f"--device: this machine has no '{name}' that torch {torch.__version__} can use; use cpu")
    return name


def _check_spacing(spacing: float | None, recording: geometry.Recording) -> None:
    """A spacing in millimetres is the likeliest slip: it leaves no room for a particle."""
    vertices = recording.wall_for("--spacing").at(0).vertices
    narrowest = float(np.ptp(vertices, axis=0).min())
    if spacing is not None and spacing > narrowest / 3:
        raise ValueError(
            f"--spacing: {spacing:g} m leaves fewer than 3 particles across the walls ({narrowest:.3g} m); "
            "it is in metres, 1 mm is 0.001"
        )


def _output_file(name: str) -> Path:
    path = Path(name)
    if path.is_dir():
        raise ValueError(f"--out {path}: is a folder; name a file")
    if not path.parent.is_dir():
        raise ValueError(f"--out {path}: the folder {path.parent} does not exist")
    return path


def _config(args: argparse.Namespace, **extra: Any) -> dict[str, Any]:
    options = {name: value for name, value in vars(args).items() if name not in ("run", "measurement", "method")}
    return {"torchsph": __version__, "torch": torch.__version__, **options, **extra}


def _print_table(rows: Sequence[Sequence[str]], text: bool = False) -> None:
    """Columns lined up: the first to the left, numbers to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        first, *rest = zip(row, widths, strict=True)
        cells = [first[0].ljust(first[1])] + [c.ljust(w) if text else c.rjust(w) for c, w in rest]
        print("  ".join(cells).rstrip())


def _say(message: str) -> None:
    print(message, file=sys.stderr)


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "assimilate": assimilate,
    "forecast": forecast,
    "measure": measure,
    "smooth": smooth,
    "quantify": quantify,
    "info": info,
    "convert": convert,
    "export": export,
}
