"""`torchsph forecast`: skill of the simulator against lead time, beside persistence."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial

import numpy as np

import geometry
from torchsph.evaluation import figures
from torchsph.evaluation.frames import SAME_TIME
from torchsph.methods import by_name
from torchsph.methods.budget import Afforded, forecast_spacing
from torchsph.methods.forecast_skill import starts
from torchsph.methods.runtime.workers import chosen_workers

from ..arguments import add_model_options, add_output_folder, add_seed, add_workers, seconds, whole
from ..budget import chosen_spacing
from ..checks import check_spacing, full_vectors, usable_device
from ..command import Command
from ..outputs import output_folder, staged, write_json, write_result
from ..printing import print_table, run_config, say
from ..running.folder_lock import locked
from ..running.notes import shows_bar
from ..running.provenance import provenance
from ..running.settings import write_config

# lead times in s where none are named
LEADS = (0.005, 0.01, 0.02, 0.04)


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", metavar="RECORDING.h5")
    parser.add_argument(
        "--leads",
        type=seconds,
        metavar="S[,S]",
        help=f"lead times in s ({','.join(f'{t:g}' for t in LEADS)})",
    )
    parser.add_argument(
        "--every", type=whole(1), default=1, metavar="K", help="start from each K-th frame (%(default)s)"
    )
    add_model_options(parser)
    add_workers(parser)
    add_seed(parser)
    parser.add_argument("--save", action="store_true", help="also write the forecasts, one recording for each lead")
    add_output_folder(parser)


def forecast(args: argparse.Namespace) -> None:
    """`torchsph forecast`: skill of the simulator against lead time, beside persistence."""
    folder, device = output_folder(args.out), usable_device(args.device)
    recording = full_vectors(geometry.read_recording(args.recording), args.recording)
    leads = _leads_within(args.leads, recording, args.every)
    account = provenance(args, {"recording": args.recording})
    bought = chosen_spacing(args, partial(_afforded, recording, leads, args))
    check_spacing(args.spacing, recording)
    skill = by_name.forecast_skill(
        recording,
        leads,
        every=args.every,
        preset=args.preset,
        spacing=args.spacing,
        device=device,
        save=args.save,
        progress=shows_bar(args),
        seed=args.seed,
        workers=args.workers,
    )
    config = run_config(args, recording=args.recording, leads=leads) | dict(skill.config)
    if bought is not None:
        account["budget"] = bought
    account["processes"] = max(account["processes"], config.pop("processes", 1))
    config["info"] = {"provenance": account}
    with locked(folder), staged(folder) as scratch:
        for lead, saved in skill.recordings.items():
            write_result(scratch / f"forecast_{1e3 * lead:g}ms.h5", saved, account)
        figures.draw_forecast(scratch / "forecast.png", skill.leads)
        write_config(scratch, args)
        found = {"leads": skill.leads, "seconds": skill.seconds, "config": config, "failures": skill.failures}
        write_json(scratch / "metrics.json", found)
    rows = [["lead ms", "starts", "model", "persistence"]]
    for row in skill.leads:
        errors = [f"{row['nrmse'][name]:.3f}" for name in ("model", "persistence")]
        rows.append([f"{1e3 * row['lead']:g}", str(row["starts"]), *errors])
    print_table(rows)
    for failed in skill.failures:
        say(f"no forecast from frame {failed['frame']} ({failed['time']:g} s): {failed['reason']}")
    if skill.failures:
        say(f"{len(skill.failures)} of the starts failed; the errors above are of the others")
    say(f"wrote forecast.png, metrics.json{' and the forecasts' if args.save else ''} to {folder}/")


def _afforded(
    recording: geometry.Recording, leads: Sequence[float], args: argparse.Namespace, budget: float
) -> Afforded:
    """The spacing that a budget in seconds buys."""
    return forecast_spacing(
        recording,
        leads,
        budget,
        every=args.every,
        preset=args.preset,
        device=args.device,
        processes=chosen_workers(args.workers, len(starts(recording, leads, args.every))),
    )


def _leads_within(leads: Sequence[float] | None, recording: geometry.Recording, every: int) -> tuple[float, ...]:
    """The leads at which a start has a later frame to compare with; one that was asked for must have it."""
    time = np.asarray(recording.time)
    later = time[None, :] - time[::every, None]
    wanted = LEADS if leads is None else leads
    usable = tuple(lead for lead in wanted if (np.abs(later - lead) < SAME_TIME).any())
    missing = [f"{lead:g}" for lead in wanted if lead not in usable]
    possible = np.unique(later[later > SAME_TIME].round(9))
    if missing and (leads is not None or not usable):
        listed = ", ".join(f"{lead:g}" for lead in possible[:6]) + (", ..." if len(possible) > 6 else "")
        raise ValueError(
            f"--leads: no frame lies {', '.join(missing)} s after a start; possible are {listed or 'none'}"
        )
    if missing:
        say(f"left out the leads {', '.join(missing)} s: no two frames are that far apart")
    return usable


COMMAND = Command(
    "forecast", """Forecast a recording from its own frames and compare with the later ones.""", _arguments, forecast
)
