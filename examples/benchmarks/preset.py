"""Components of the weakly compressible preset against what could replace them, on a ventricle and on a vortex.

    python examples/benchmarks/preset.py [--quick] [--json FILE] [--recording FILE] [--threads N]

Ventricle: NRMSE of forecasts from a few frames of a recording without noise, 10 and 40 ms ahead (without --recording
the sample that comes with torchsph). Vortex: relative L2 velocity error of Taylor-Green in the plane, Re 100, on
40^2 particles, a fifth of a decay time after its start. Each row changes one component of the preset and nothing else.

Measured (results/preset.json: --recording lv_phantom_a.h5 --every 30, 1.25 mm; three starts, persistence .33 and .88):

                                              10 ms   40 ms  CPU s  vortex
    preset: as it is                            0.185   0.389      7.6   0.1008
    preset: projection instead                  0.196   0.380      5.3   0.0635
    kernel: cubic                               0.186   0.388      5.7   0.0685
    kernel: quintic, h = 1                      0.187   0.392      6.7   0.1202
    kernel: Wendland C4, h = 1.6                0.182   0.383      5.9   0.0647
    smoothing ratio: 1.1                        0.200   0.461      5.5   0.1615
    smoothing ratio: 1.6                        0.184   0.402      6.5   0.0577
    sound speed: 3.5 m/s                        0.185   0.377      5.6   0.0880
    sound speed: 10 m/s                         0.188   0.421      7.3   0.2212
    pressure: sum                               0.184   0.381      5.6   0.1000
    pressure: symmetric                         0.184   0.380      5.6   0.0995
    pressure: difference                        0.188   0.388      5.7   0.0533
    density diffusion: none                      failed            6.9   0.1150
    density diffusion: 0.1                      0.188   0.403      7.1   0.1069
    density diffusion: 0.4                      0.183   0.390      8.2   0.0921
    density diffusion: corrected                0.187   0.381      6.7   0.1137
    bulk damping: none                          0.185   0.383      5.9   0.1138
    bulk damping: 1.0                           0.185   0.388      5.9   0.0900
    artificial viscosity: 0.02                  0.196   0.404      6.6   0.1026
    artificial viscosity: 0.1                   0.258   0.535      6.6   0.1125
    laminar viscosity: none                     0.187   0.391      6.1   0.1975
    shifting: none                              0.223   0.499      6.2   0.4960
    shifting: 0.5, local speed                  0.214   0.486      5.4   0.4388
    shifting: 1                                 0.195   0.420      7.5   0.3080
    shifting: 8                                 0.187   0.383      6.9   0.0656
    courant: 0.35                               0.185   0.388      6.9   0.0971
    courant: 0.7                                0.185   0.391      5.0   0.1063
    transfer: plain fetch                       0.250   0.391      6.0
    transfer: velocities not projected          0.186   0.388      6.7
    seeding: not packed                         0.184   0.379      5.6
    XSPH: positions, 0.2                        0.185   0.391      6.7   0.1019
    order: thesis                               0.258   0.953      6.7   0.4839
    order: verlet                               0.186   0.392      7.0   0.0996
    order: predictor_corrector                  0.186   0.391      6.0   0.1009
    wall: potential                             3.288   5.085      5.8
    wall: complete, free slip                   0.190   0.392      5.3
    valve: flat reservoir                       0.229   0.525      6.1
    valve: volume not held                      0.185   0.382      5.8
    valve: run-out of 3                         0.188   0.392      6.7
    valve: pressure source                      0.729   0.887      6.0
    valve: shut                                 0.377   0.704      3.3

What the preset owes its accuracy to: reservoirs with the field's own profile, complete kernels at the wall, strong
shifting by the largest speed (40 ms: .486 to .389 against the weak local one), no artificial viscosity (.535 at 0.1),
density diffusion (it fails without), and the lost detail carried on (10 ms: .250 without). Kernel, pressure form, bulk
damping, XSPH, order of the steps and packing hardly matter here. The first row's seconds hold the making of the wall
fields; the incompressible scheme takes three quarters of the time, is better after 40 ms and worse after 10.
"""

import argparse
import math
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch

import geometry
from examples.provenance import MODEL, write_table
from torchsph import (
    XSPH,
    CompleteKernelWall,
    NumericalFailure,
    PopulationControl,
    PotentialWall,
    PressureSource,
    Reservoir,
    Scene,
    Seeding,
    Simulator,
    Transfer,
    preset,
    skill,
)
from torchsph.data import sample_truth
from torchsph.simulator.schemes.scheme import Scheme
from torchsph.validation.runs import taylor_green, taylor_green_error

SOURCES = ("examples/benchmarks/preset.py", "torchsph/methods/forecast_skill.py", *MODEL)

LEADS = (0.01, 0.04)  # s
DECAY_TIME = 100 / (8 * math.pi**2)
NO_SLIP_OFF = CompleteKernelWall(no_slip=False)

# component -> its rivals; the row without changes is the preset
RIVALS: dict[str, dict[str, dict[str, object]]] = {
    "preset": {"as it is": {}, "projection instead": {"preset": "projection"}},
    "kernel": {
        "cubic": {"kernel": "cubic"},
        "quintic, h = 1": {"kernel": "quintic", "smoothing_ratio": 1.0},
        "Wendland C4, h = 1.6": {"kernel": "wendland_c4", "smoothing_ratio": 1.6},
    },
    "smoothing ratio": {"1.1": {"smoothing_ratio": 1.1}, "1.6": {"smoothing_ratio": 1.6}},
    "sound speed": {"3.5 m/s": {"sound_speed": 3.5}, "10 m/s": {"sound_speed": 10.0}},
    "pressure": {form: {"pressure": form} for form in ("sum", "symmetric", "difference")},
    "density diffusion": {
        "none": {"density_diffusion": None},
        "0.1": {"density_diffusion": 0.1},
        "0.4": {"density_diffusion": 0.4},
        "corrected": {"diffusion_form": "corrected"},
    },
    "bulk damping": {"none": {"bulk_damping": None}, "1.0": {"bulk_damping": 1.0}},
    "artificial viscosity": {"0.02": {"artificial_viscosity": 0.02}, "0.1": {"artificial_viscosity": 0.1}},
    "laminar viscosity": {"none": {"laminar_viscosity": False}},
    "shifting": {
        "none": {"shifting": None},
        "0.5, local speed": {"shifting": 0.5, "shifting_speed": "local"},
        "1": {"shifting": 1.0},
        "8": {"shifting": 8.0},
    },
    "courant": {"0.35": {"courant": 0.35}, "0.7": {"courant": 0.7}},
    "transfer": {
        "plain fetch": {"transfer": Transfer(fade=None)},
        "velocities not projected": {"transfer": Transfer(projections=0)},
    },
    "seeding": {"not packed": {"seeding": Seeding(packings=0)}},
    "XSPH": {"positions, 0.2": {"xsph": XSPH(0.2, "position")}},
    "order": {name: {"order": name} for name in ("thesis", "verlet", "predictor_corrector")},
    "wall": {"potential": {"wall": PotentialWall()}, "complete, free slip": {"wall": NO_SLIP_OFF}},
    "valve": {
        "flat reservoir": {"valve": Reservoir("flat")},
        "volume not held": {"valve": Reservoir(relaxation=None)},
        "run-out of 3": {"valve": Reservoir(run_out=3.0)},
        "pressure source": {"valve": PressureSource()},
        "shut": {"valve": None},
    },
    "population": {"controlled": {"population": PopulationControl()}},
}
# what a flow without walls does not have
WALLS_ONLY = ("wall", "valve", "transfer", "seeding")
# shown by --quick
QUICK = ("preset", "pressure", "shifting")


def scheme(changes: dict[str, object]) -> Scheme:
    """The weakly compressible preset with changes, or another preset."""
    return preset(changes["preset"]) if "preset" in changes else preset("weakly_compressible", **changes)


def ventricle(recording: geometry.Recording, spacing: float, every: int, changes: dict[str, object]) -> dict:
    """NRMSE per lead and CPU seconds of forecasts with the changed preset; None where the run failed."""
    began = time.process_time()
    try:
        rest = dict(changes)
        transfer, seeding = rest.pop("transfer", None), rest.pop("seeding", None)
        model = Simulator(Scene.from_recording(recording, spacing), scheme(rest), seeding=seeding)
        result = skill(recording, model, LEADS, every=every, transfer=transfer)
    except NumericalFailure:
        return {"nrmse": None, "cpu_s": time.process_time() - began}
    return {
        "nrmse": {f"{1e3 * row['lead']:g} ms": row["nrmse"]["model"] for row in result.leads},
        "persistence": {f"{1e3 * row['lead']:g} ms": row["nrmse"]["persistence"] for row in result.leads},
        "starts": result.leads[0]["starts"],
        "cpu_s": time.process_time() - began,
    }


def vortex(resolution: int, changes: dict[str, object]) -> dict:
    """Error and CPU seconds of the vortex with the changed preset; None where the run failed."""
    run = taylor_green(resolution, scheme=scheme(changes))
    began = time.process_time()
    try:
        run.advance(DECAY_TIME / 5)
    except NumericalFailure:
        return {"error": None, "cpu_s": time.process_time() - began}
    return {"error": taylor_green_error(run), "cpu_s": time.process_time() - began}


def line(row: dict) -> str:
    """A row of the table as text."""
    flow, plane = row["ventricle"], row.get("vortex")
    nrmse = "  failed" if flow["nrmse"] is None else "  ".join(f"{value:6.3f}" for value in flow["nrmse"].values())
    error = "" if plane is None else "failed" if plane["error"] is None else f"{plane['error']:.4f}"
    name = f"{row['component']}: {row['rival']}"
    return f"{name:<42} {nrmse:<16} {flow['cpu_s']:6.1f} {error:>8}"


def main() -> None:
    """Run the rows, print them, write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few rows, coarse, from one frame: under a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows here")
    parser.add_argument("--recording", type=Path, metavar="FILE", help="recording of a ventricle (default: the sample)")
    parser.add_argument("--spacing", type=float, default=1.25e-3, help="of the ventricle's particles, m; --quick: 2 mm")
    parser.add_argument("--every", type=int, default=10, help="frames between the starts of forecasts")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch (default 1)")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    file = options.recording or sample_truth()
    recording = geometry.read_recording(str(file))
    if options.quick:
        options.spacing, options.every = 2e-3, recording.frames
    ventricle(recording, options.spacing, recording.frames, {})  # loads the kernels outside the clock
    rows = []
    print(f"{'component: rival':<42} {'NRMSE':<16} {'CPU s':>6} {'vortex':>8}   {file.name}")
    for component, rivals in RIVALS.items():
        for rival, changes in rivals.items() if not options.quick or component in QUICK else ():
            row = {
                "component": component,
                "rival": rival,
                "ventricle": ventricle(recording, options.spacing, options.every, changes),
            }
            if component not in WALLS_ONLY:
                row["vortex"] = vortex(20 if options.quick else 40, changes)
            rows.append(row)
            print(line(row), flush=True)
    if options.json:
        report = {
            "rows": rows,
            "recording": file.name,
            "spacing": options.spacing,
            "every": options.every,
            "load": os.getloadavg()[0],
        }
        write_table(options.json, report, SOURCES)


if __name__ == "__main__":
    main()
