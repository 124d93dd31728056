"""What a member costs in a batch of many, and how far from real time an ensemble's forecasts are.

    python examples/benchmarks/costs/members.py [--quick] [--json FILE] [--spacing M] [--members N ...] [--device cpu]

Forecasts of the sample from frame to frame (10 ms), as the ensemble makes them: imposed, projected, advanced,
fetched; default preset, one thread. Sizes of the batch take turns, and of the repeats the cheapest counts, so that what
else the machine does weighs on all alike.

    CPU ms      per member and frame (on a GPU: wall-clock, and so in the next columns)
    over one    that over the cost of a batch of one
    real time   seconds of computing for a second of the beat, all members together; below 1 is faster than the heart

Measured (--quick, on a machine that others used as well, one thread of an AMD EPYC):

          1    102.3       1.00       10.23
          8     25.9       0.25       20.69
         32     18.3       0.18       58.42
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import numpy as np
import torch

import geometry
from torchsph import Scene, Simulator, preset
from torchsph.data import sample_measurement
from torchsph.simulator.grid_forecast import GridForecast, Transfer


def forecasts(measured: geometry.Recording, model: Simulator, members: int, clock: Callable[[], float]) -> float:
    """Seconds for all frames of a batch."""
    time_, grid = measured.time, measured.grid
    masks = [torch.from_numpy(np.array(mask, bool)).to(model.device) for mask in measured.mask]
    fields = torch.from_numpy(np.nan_to_num(measured.velocity)).to(model.device)
    began = clock()
    for frame in range(measured.frames - 1):
        start = fields[frame].expand(members, *fields.shape[1:])
        going = GridForecast(model, grid, start, masks[frame], float(time_[frame]), Transfer())
        going.at(float(time_[frame + 1]), masks[frame + 1])[0].cpu()
    return clock() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two frames, 1, 8 and 32 members, one repeat")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--spacing", type=float, default=2e-3, help="m, between particles")
    parser.add_argument("--members", type=int, nargs="+", default=[1, 8, 16, 32, 64])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    frames = 6
    if args.quick:
        args.members, args.repeats, frames = [1, 8, 32], 1, 3
    torch.set_num_threads(1)
    measured = geometry.read_recording(sample_measurement()).select(slice(8, 8 + frames))
    scene = Scene.from_recording(measured, args.spacing)
    model = Simulator(scene, preset("default"), device=args.device)
    clock = time.process_time if args.device == "cpu" else time.perf_counter
    forecasts(measured, model, 1, clock)  # wall fields are made once
    least = dict.fromkeys([1, *args.members], float("inf"))
    for _ in range(args.repeats):
        for members in least:
            least[members] = min(least[members], forecasts(measured, model, members, clock))
    beat, rows = float(np.ptp(measured.time)), []
    print("members   CPU ms   over one   real time")
    for members, seconds in least.items():
        each = seconds / members
        row = {
            "members": members,
            "spacing": args.spacing,
            "device": args.device,
            "milliseconds": 1e3 * each / (frames - 1),
            "over_one": each / least[1],
            "real_time": seconds / beat,
        }
        rows.append(row)
        print(f"{members:7d} {row['milliseconds']:8.1f} {row['over_one']:10.2f} {row['real_time']:11.2f}")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
