"""What rivals are judged on: two noise levels of the phantom, echoes of it that were tracked, a public 4D flow."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import geometry
from torchsph.cli import main as torchsph
from torchsph.ultrasound import SpeckleOptions, measure_speckle

PHANTOM = "lv_phantom_a.h5"
TRACKED = slice(50, 71, 2)  # frames of the phantom: 250 to 350 ms, filling
AORTA = "--velocity u,v,w --mask mask --spacing dx --length-unit mm --axes auto"


@dataclass(frozen=True)
class Case:
    """A measurement whose truth is known.

    Attributes:
        title: of its table.
        about: a sentence below the title.
        tuned_at: noise level of the tuning ventricle whose settings are taken.
        read: measurement and truth at its times, from the folder of the data and a folder for what is made.
        leaves_out: rivals and own methods that it is nothing for.
        beats: whether there are a beat, walls that move and pressures to read out.
    """

    title: str
    about: str
    tuned_at: str
    read: Callable[[Path, Path], tuple[geometry.Recording, geometry.Recording]]
    leaves_out: tuple[str, ...] = ()
    beats: bool = True


def at_times(truth: geometry.Recording, measured: geometry.Recording) -> geometry.Recording:
    """The true frames at the measurement's times."""
    return truth.select(np.isin(np.rint(1e5 * truth.time), np.rint(1e5 * measured.time)))


def phantom(noise: str) -> Callable[[Path, Path], tuple[geometry.Recording, geometry.Recording]]:
    """A noise model's measurement of the phantom."""

    def read(data: Path, _: Path) -> tuple[geometry.Recording, geometry.Recording]:
        measured = geometry.read_recording(str(data / f"lv_phantom_a_{noise}.h5"))
        return measured, at_times(geometry.read_recording(str(data / PHANTOM)), measured)

    return read


def tracked(data: Path, kept: Path) -> tuple[geometry.Recording, geometry.Recording]:
    """Simulated echoes of the phantom's filling, tracked; made once."""
    truth, file = geometry.read_recording(str(data / PHANTOM)), kept / "tracked.h5"
    if not file.is_file():
        kept.mkdir(parents=True, exist_ok=True)
        geometry.write_recording(str(file), measure_speckle(truth.select(TRACKED), SpeckleOptions(every=1), seed=0))
    measured = geometry.read_recording(str(file))
    return measured, at_times(truth, measured)


def aorta(data: Path, kept: Path) -> tuple[geometry.Recording, geometry.Recording]:
    """The 4D flow of an aorta simulated from CFD (4DFlowNet), and every other node of the CFD itself."""
    found = {}
    for name in ("example_data", "example_data_HR"):
        file = kept / f"{name}.h5"
        if not file.is_file():
            kept.mkdir(parents=True, exist_ok=True)
            source = data / "real" / "aorta_4dflownet" / f"{name}.h5"
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                code = torchsph(["convert", str(source), *AORTA.split(), "--out", str(file)])
            if code:
                raise FileNotFoundError(f"{source} was not converted; is it there?")
        found[name] = geometry.read_recording(str(file))
    measured, fine = found.values()
    every = (..., *(slice(None, None, 2),) * 3)
    both = np.asarray(measured.mask, bool) & np.asarray(fine.mask, bool)[every]
    return measured, replace(measured, velocity=fine.velocity[every], mask=both)


CASES = {
    "measured": Case("Measured phantom", "44 frames, 10 ms apart.", "measured", phantom("measured")),
    "noisy": Case("Noisy phantom", "The same at twice the noise.", "noisy", phantom("noisy")),
    "tracked": Case(
        "Tracked echoes",
        "Eleven frames of the phantom's filling, of whose echoes a speckle tracker has accepted a third of the nodes.",
        "noisy",
        tracked,
    ),
    "aorta": Case(
        "4D flow of an aorta",
        "One public frame with hardly any noise: what a method takes from a flow that needs none of it. The "
        "measurement itself is {raw:.3f} off.",
        "measured",
        aorta,
        leaves_out=("ensemble", "spline over time", "gaussian over time", "leray over time", "ivfm over time", "pinn"),
        beats=False,
    ),
}
