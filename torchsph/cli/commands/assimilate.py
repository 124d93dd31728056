"""`torchsph assimilate`: methods on one measurement, scored, drawn and written."""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import geometry
from geometry.formats import write_sidecar
from torchsph import data
from torchsph.assimilation import filter_figure
from torchsph.evaluation import figures, metrics
from torchsph.evaluation.scores import Scores
from torchsph.methods import by_name
from torchsph.methods.budget import Afforded, ensemble_spacing
from torchsph.methods.measurement.beats import stitched
from torchsph.methods.runtime import checkpoint, parallel
from torchsph.methods.runtime.workers import chosen_workers
from torchsph.report import write_report

from ..arguments import add_model_options, add_output_folder, add_seed, add_sidecar, add_workers, names, number, whole
from ..budget import NAME as SPACING_FILE
from ..budget import chosen_spacing
from ..checks import check_spacing, informative, usable_device
from ..command import Command
from ..cures import about
from ..outputs import output_folder, staged, write_json, write_result
from ..printing import print_table, run_config, say
from ..quantity_tables import QuantityTables, methods_read_out
from ..running.folder_lock import locked
from ..running.notes import shows_bar
from ..running.provenance import provenance
from ..running.settings import write_config
from ..running.status import RunWatcher, StatusFile
from ..running.stopping import StopSignals


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("measurement", nargs="?", metavar="MEASUREMENT.h5", help="a recording with /weight or /sigma")
    parser.add_argument("--truth", metavar="TRUTH.h5", help="the true flow, to compute errors against")
    parser.add_argument(
        "--also",
        action="append",
        default=[],
        metavar="FILE.h5",
        help="a further measurement of the same beat, with its own grid, times and errors (repeatable)",
    )
    parser.add_argument(
        "--beats",
        action="store_true",
        help="the files hold several beats: the first whole one is analysed, the others are further measurements of it",
    )
    add_method_options(parser)
    parser.add_argument("--resume", action="store_true", help="go on with the ensemble where DIR/checkpoint.pt left it")
    add_output_folder(parser)
    parser.add_argument("--status", metavar="FILE.jsonl", help="append a line for every frame: how far, how long yet")


def add_method_options(parser: argparse.ArgumentParser) -> None:
    """What is run, and how: the options that do not name a file."""
    parser.add_argument("--method", type=names, metavar="NAME[,NAME]", help="free, spline, sph, ensemble")
    add_model_options(parser)
    parser.add_argument(
        "--control-spacing",
        type=number(0, open_below=True),
        metavar="M",
        help="of the particles of the ensemble's control run, m (half of the members')",
    )
    parser.add_argument("--members", type=whole(2), metavar="N", help="size of the ensemble")
    parser.add_argument(
        "--lag", type=whole(1), metavar="N", help="frames whose data still move the ensemble's earlier analyses (off)"
    )
    parser.add_argument(
        "--minimum-members", type=whole(1), metavar="N", help="end the run where fewer live through a forecast (1)"
    )
    parser.add_argument("--no-page", action="store_true", help="leave out report.html")
    add_workers(parser)
    add_seed(parser)
    add_sidecar(parser)
    parser.add_argument(
        "--quantities",
        action="store_true",
        help="energy, pressure, flow rates ... without an ensemble too: of splines with draws from their posterior",
    )
    parser.add_argument("--no-quantities", action="store_true", help="leave out quantities.json, quantities.csv")
    parser.add_argument("--keep-members", action="store_true", help="write the ensemble's members to DIR/members.h5")


def assimilate(args: argparse.Namespace) -> None:
    """`torchsph assimilate`: every asked method on one measurement, scored, drawn and written.

    Under torchrun the processes share the ensemble's simulations; the first one writes and prints.
    """
    measured_path, truth_path, methods = _inputs(args)
    folder = output_folder(args.out, _files(methods))
    device = parallel.own_device(usable_device(args.device))
    lead = parallel.is_lead()
    held = locked(folder) if lead else nullcontext(folder)
    with held, StatusFile(args.status if lead else None) as status, StopSignals() as signals:
        account = provenance(args, {"measurement": measured_path, "truth": truth_path, "also": args.also})
        measured, *also = _measurements(measured_path, args)
        truth = None if truth_path is None else geometry.read_recording(truth_path)
        kept = folder / SPACING_FILE if "ensemble" in methods and lead else None
        if not args.resume and kept is not None:
            kept.unlink(missing_ok=True)
        bought = chosen_spacing(args, partial(_afforded, measured, methods, args), kept)
        check_spacing(args.spacing, measured)
        check_spacing(args.control_spacing, measured, "--control-spacing")
        read_out = methods_read_out(args, methods, measured)
        with about(str(truth_path or measured_path)):  # first: a truth that does not fit must not cost a run
            raw = metrics.evaluate(measured, truth, measured)
        saved, resume = folder / "checkpoint.pt", args.resume
        if "ensemble" in methods and lead:
            resume = _kept(saved, args.resume)
        with parallel.joined():
            results = by_name.run_methods(
                measured,
                methods,
                preset=args.preset,
                spacing=args.spacing,
                control_spacing=args.control_spacing,
                members=args.members,
                lag=args.lag,
                minimum_members=args.minimum_members,
                also=also,
                truth=truth,
                checkpoints=saved,
                resume=resume,
                watcher=RunWatcher(signals, status),
                seed=args.seed,
                device=device,
                progress=lead and shows_bar(args),
                quantities=read_out,
                keep_members=folder / "members.h5" if args.keep_members else None,
                workers=args.workers,
            )
        if not lead:
            return
        account["processes"] = max(account["processes"], *(one.info.get("processes", 1) for one in results.values()))
        if bought is not None:
            account["budget"] = bought
        signals.waits = True  # what is left are seconds, and all the work is in them
        chosen = by_name.DEFAULT_METHOD if by_name.DEFAULT_METHOD in methods else methods[0]
        config = run_config(args, measured=measured_path, truth=truth_path, methods=methods, analysis=chosen)
        _write(folder, measured, truth, results, raw, config, account, args)
        if "ensemble" in methods:
            saved.unlink(missing_ok=True)  # the run is complete: there is nothing to go on with
            (folder / SPACING_FILE).unlink(missing_ok=True)


def _files(methods: Sequence[str]) -> list[str]:
    """All that a run of these methods may leave in its folder."""
    fields = [f"{name}{end}" for name in (*methods, "analysis") for end in (".h5", ".vtkhdf", "_wall.vtkhdf")]
    tables = ["members.h5", "quantities.json", "quantities.csv"]
    return [*fields, *tables, "report.png", "report.html", "filter.png", "metrics.json", "config.toml"]


def _measurements(path: Path, args: argparse.Namespace) -> Sequence[geometry.Recording]:
    """The measurement and all further ones of the same beat."""
    every = [informative(geometry.read_recording(one), one) for one in (path, *args.also)]
    return stitched(every)[0] if args.beats else every


def _afforded(
    measured: geometry.Recording, methods: Sequence[str], args: argparse.Namespace, budget: float
) -> Afforded:
    """The spacing that a budget in seconds buys."""
    members = by_name.DEFAULT_MEMBERS if args.members is None else args.members
    tasks = by_name.parallel_tasks(measured.frames, methods, members)
    return ensemble_spacing(
        measured,
        budget,
        members=members,
        preset=args.preset,
        device=args.device,
        processes=chosen_workers(args.workers, tasks),
        methods=methods,
    )


def _kept(saved: Path, resume: bool) -> bool | checkpoint.Saved:
    """What to go on from, refused before any work where it cannot be; also refused is a file that would be replaced."""
    if resume:
        return checkpoint.Saved.read(saved) or True
    checkpoint.refuse_other_file(saved)
    if saved.exists():
        say(f"{saved}: an earlier run was interrupted; this one begins anew and replaces it (--resume goes on with it)")
    return False


def _write(
    folder: Path,
    measured: geometry.Recording,
    truth: geometry.Recording | None,
    results: Mapping[str, by_name.MethodResult],
    raw: Scores,
    config: dict[str, Any],
    account: dict[str, Any],
    args: argparse.Namespace,
) -> None:
    """Score, draw and write the results; print what they are worth.

    Args:
        folder: of the files.
        measured: the measurement.
        truth: to compare with, or None.
        results: of each method.
        raw: the measurement's own scores.
        config: what was asked for.
        account: where the results come from.
        args: all options of the run.
    """
    analyses = {name: result.recording for name, result in results.items()}
    scores = {"raw": raw} | {name: metrics.evaluate(each, truth, measured) for name, each in analyses.items()}
    seconds = {name: result.seconds for name, result in results.items()}
    config["info"] = {name: result.info for name, result in results.items()} | {"provenance": account}
    if truth is not None:
        claims = {name: metrics.spread_over_skill(recording, truth) for name, recording in analyses.items()}
        config["spread_over_skill"] = {name: claim.value for name, claim in claims.items() if claim is not None}
    tables = None
    if args.quantities or results[config["analysis"]].quantities is not None:
        tables = QuantityTables.of(analyses[config["analysis"]], results[config["analysis"]].quantities, truth)
    with staged(folder) as scratch:
        for name, recording in analyses.items():
            write_result(scratch / f"{name}.h5", recording, account | {"method": name})
        shutil.copyfile(scratch / f"{config['analysis']}.h5", scratch / "analysis.h5")
        for name in () if args.no_sidecar else (*analyses, "analysis"):
            write_sidecar(scratch / f"{name}.h5", analyses[config["analysis"] if name == "analysis" else name])
        figures.draw_report(scratch / "report.png", measured, analyses, scores, truth, seconds)
        if "ensemble" in results:
            filter_figure(results["ensemble"].info["filter"]).savefig(scratch / "filter.png", dpi=110)
        write_config(scratch, args)
        write_json(scratch / "metrics.json", metrics_document(measured, scores, seconds, config))
        if tables is not None:
            tables.write(scratch, {key: value for key, value in config.items() if key != "info"})
        if not args.no_page:
            _write_page(scratch, measured, truth, results, scores, config)
    print_table(figures.scores_table(scores, seconds))
    if tables is not None:
        print_table(tables.table())
        say(tables.caution)
    for words in results["ensemble"].info["filter"]["warnings"] if "ensemble" in results else ():
        say(f"ensemble: {words}")
    files = ", ".join(f"{name}.h5" for name in analyses)
    page = "" if args.no_page else "report.html, "
    say(f"wrote {files}, analysis.h5 (= {config['analysis']}.h5), {page}report.png and metrics.json to {folder}/")
    say(figures.NOT_CLINICAL)


def _write_page(
    scratch: Path,
    measured: geometry.Recording,
    truth: geometry.Recording | None,
    results: Mapping[str, by_name.MethodResult],
    scores: Mapping[str, Scores],
    config: Mapping[str, Any],
) -> None:
    """Write `report.html` of the analysis, with the quantities where they were written before.

    Args:
        scratch: folder of the results.
        measured: the measurement.
        truth: the true flow, or None.
        results: of each method.
        scores: of each method, and of the measurement as `raw`.
        config: what was asked for.
    """
    chosen, quantities = config["analysis"], scratch / "quantities.json"
    mended = [result.info["estimates"] for result in results.values() if "estimates" in result.info]
    write_report(
        scratch / "report.html",
        results[chosen].recording,
        measured,
        truth=truth,
        name=chosen,
        title=f"Flow of {Path(config['measured']).name}",
        scores=scores,
        seconds={name: result.seconds for name, result in results.items()},
        quantities=json.loads(quantities.read_text(encoding="utf-8")) if quantities.exists() else None,
        estimates=mended[0] if mended else None,
        account=config["info"]["provenance"],
        notes=results["ensemble"].info["filter"]["warnings"] if "ensemble" in results else (),
    )


def _inputs(args: argparse.Namespace) -> tuple[Path, Path | None, tuple[str, ...]]:
    """The measurement's file, the truth's, and the methods that are run."""
    truth: Path | None
    if args.measurement is None:
        if args.truth is not None:
            raise ValueError("--truth needs MEASUREMENT.h5 (without it the sample runs, which has its own truth)")
        measured, truth = Path(data.sample_measurement()), Path(data.sample_truth())
        methods = args.method or tuple(by_name.METHODS)
    else:
        measured, truth = Path(args.measurement), None if args.truth is None else Path(args.truth)
        methods = args.method or (by_name.DEFAULT_METHOD,)
    if args.budget is not None and args.control_spacing is not None:
        raise ValueError("--budget chooses the spacing: leave --control-spacing out, or leave --budget out")
    unknown = [name for name in methods if name not in by_name.METHODS]
    members = by_name.DEFAULT_MEMBERS if args.members is None else args.members
    if members < (args.minimum_members or 0):
        raise ValueError(f"--minimum-members: {args.minimum_members} are to live, but there are only {members} members")
    if unknown:
        raise ValueError(f"--method: unknown {', '.join(unknown)}; known are {', '.join(by_name.METHODS)}")
    return measured, truth, methods


def metrics_document(
    measured: geometry.Recording,
    scores: Mapping[str, Scores],
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


COMMAND = Command(
    "assimilate",
    """Turn a noisy measured recording into analysed velocity fields.

    Without a file, every method runs on the sample that ships with the package; with a file and no --method,
    the default method alone.""",
    _arguments,
    assimilate,
)
