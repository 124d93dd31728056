"""How fast the speckle tracker is: beside a plain SciPy program and OpenPIV, in one run on the same volumes.

    python examples/benchmarks/ultrasound/tracking_speed.py [--quick] [--json FILE]

The plain program goes point by point and pair by pair, with `scipy.signal.correlate` (directly and by Fourier
transforms) and the same pooled normalisation, search and parabola; a third one, tuned by hand, transforms all
images of a point at once and sums over the pairs in k-space. OpenPIV's
three-dimensional correlation joins where it is installed; it gets every image pair of a smaller packet, since
it has no packets. A packet of the phantom's size is simulated and tracked as well, and the memory that
tracking takes is read off the process. All times are of the processor, the shortest of several interleaved runs,
since the machine may be shared; set OMP_NUM_THREADS=1, or the threads add up.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import numpy as np
import torch
from scipy.fft import fftn, ifftn
from scipy.ndimage import uniform_filter
from scipy.signal import correlate as scipy_correlate
from tracking import CENTRE, STEP, image_grid, lattice

from examples.provenance import TRACKING, write_table
from geometry import Grid
from torchsph.ultrasound import EchoModel, LinearFlow, Packet, SpeckleTracker, simulate_packet
from torchsph.ultrasound.estimation.backends import choose_backend
from torchsph.ultrasound.estimation.correlation import KernelShape

SOURCES = ("examples/benchmarks/ultrasound/tracking_speed.py", *TRACKING)

PHANTOM = (20e-3, 20e-3, 33e-3)  # x, y, z, m


def plain_scipy(
    packet: Packet, powers: np.ndarray, points: torch.Tensor, method: str, search: int = 2, half: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """The same search point by point: lags (n, 3) in nodes, and |rho| (n, 5, 5, 5). ``powers``: |packet|^2.

    ``method``: of `scipy.signal.correlate`, pair by pair, or "tuned" (see the module's text).
    """
    images = packet.iq.numpy()
    nodes = packet.grid.locate(points).round().long().flip(-1).numpy()
    ones, found, heights = np.ones((2 * half + 1,) * 3, np.float32), np.zeros((len(points), 3)), []
    for number, node in enumerate(nodes):
        inner = tuple(slice(n - half, n + half + 1) for n in node)
        outer = tuple(slice(n - half - search, n + half + search + 1) for n in node)
        total, around = 0.0, powers[1:][(slice(None), *outer)].sum(0)
        if method == "tuned":
            # periodic over the region: the lags that are kept wrap nothing
            kernel = fftn(images[:-1][(slice(None), *inner)], (2 * (half + search) + 1,) * 3, axes=(1, 2, 3))
            spectrum = (kernel.conj() * fftn(images[1:][(slice(None), *outer)], axes=(1, 2, 3))).sum(0)
            total = ifftn(spectrum)[(slice(2 * search + 1),) * 3]
            energy = uniform_filter(around, 2 * half + 1)[(slice(half, half + 2 * search + 1),) * 3] * ones.size
        else:
            for first, second in zip(images[:-1], images[1:], strict=True):
                total = total + scipy_correlate(second[outer], first[inner], mode="valid", method=method)
            energy = scipy_correlate(around, ones, mode="valid", method=method)
        rho = np.abs(total) / np.sqrt(powers[:-1][(slice(None), *inner)].sum() * energy)
        heights.append(rho)
        peak = np.array(np.unravel_index(rho.argmax(), rho.shape)).clip(1, 2 * search - 1)
        for axis, unit in enumerate(np.eye(3, dtype=int)):
            low, top, high = (np.log(rho[tuple(peak + step * unit)]) for step in (-1, 0, 1))
            bend = low - 2 * top + high
            found[number, axis] = peak[axis] - search + (0.5 * (low - high) / bend if bend else 0.0)
    return found, np.stack(heights)


def our_heights(packet: Packet, points: torch.Tensor, search: int = 2, half: int = 3) -> np.ndarray:
    """|rho| (n, 5, 5, 5) of the same search here."""
    corner = packet.grid.locate(points).round().long().flip(-1) - half
    volume, sums = packet.iq.movedim(0, -1).contiguous(), choose_backend()
    rho = sums.correlate(volume, 1, corner, torch.zeros_like(corner), KernelShape((half,) * 3, (search,) * 3))
    return rho.abs().numpy()


def openpiv(packet: Packet, pairs: int) -> int:
    """Correlate ``pairs`` pairs of magnitude images with kernels and ranges like ours; vectors per pair.

    A corner of the volume only: its kernels overlap by a node, so that there are more of them than points.
    """
    from openpiv.pyprocess3D import extended_search_area_piv3D

    frames = packet.iq[:, :37, :37, :37].abs().numpy().astype(np.float64)
    for first, second in zip(frames[:pairs], frames[1 : pairs + 1], strict=True):
        found = extended_search_area_piv3D(
            first, second, window_size=(7,) * 3, overlap=(1,) * 3, search_area_size=(11,) * 3
        )
    return np.asarray(found[0]).size


def shortest(programs: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Processor seconds of each, the shortest of ``rounds`` interleaved runs."""
    best = dict.fromkeys(programs, float("inf"))
    for _ in range(rounds):
        for name, program in programs.items():
            start = time.process_time()
            program()
            best[name] = min(best[name], time.process_time() - start)
    return best


def rivals(quick: bool) -> dict[str, float]:
    """Milliseconds per point, and how many times as fast the same search is here."""
    half = 2 if quick else 6
    points, grid = lattice(half), image_grid(6 * half + 6)
    packet = simulate_packet(LinearFlow((0.3, 0.2, 0.25)), grid, EchoModel(), 0.0, torch.Generator().manual_seed(0))
    same = SpeckleTracker(clutter=None, lags=(1,), follow_shear=False, phase=False)
    full = SpeckleTracker(clutter=None)
    few, counts, programs = points[:: len(points) // 12], {}, {}
    powers = np.abs(packet.iq.numpy()) ** 2
    for name, tracker in (("ours", same), ("ours, with refinements", full)):
        programs[name] = lambda tracker=tracker: tracker.track(packet, points)
        counts[name] = len(points)
    plain = {"plain SciPy, direct": "direct", "plain SciPy, fft": "fft", "SciPy, tuned": "tuned"}
    for name, method in plain.items():
        programs[name] = lambda method=method: plain_scipy(packet, powers, few, method)
        counts[name] = len(few)
    programs["powers"], counts["powers"] = lambda: np.abs(packet.iq.numpy()) ** 2, len(points)
    try:
        counts["OpenPIV"] = openpiv(packet, 1)
        pairs = len(packet.iq) - 1
        programs["OpenPIV"] = lambda: openpiv(packet, 1)
    except ImportError:
        print("OpenPIV is not installed: left out")
    times = shortest(programs, 2 if quick else 4)
    rows = {name: 1e3 * seconds / counts[name] for name, seconds in times.items()}
    powers_share = rows.pop("powers")  # needed once for all points, of which SciPy tracks a few
    for name in plain:
        rows[name] += powers_share
        rows[f"times as fast as {name}"] = rows[name] / rows["ours"]
    if "OpenPIV" in rows:
        rows["OpenPIV"] *= pairs  # ours pools all pairs of the packet
        rows["times as fast as OpenPIV"] = rows["OpenPIV"] / rows["ours"]
    lags = same.track(packet, few).velocity * packet.acquisition.interval / STEP
    for name, method in plain.items():
        their_lags, heights = plain_scipy(packet, powers, few, method)
        rows[f"correlation's greatest difference from {name}"] = float(np.abs(heights - our_heights(packet, few)).max())
        # of theirs the parabolas run along the axes, which peaks that lie aslant do not
        rows[f"median difference from {name} (nodes)"] = float(np.median(np.abs(lags.flip(1).numpy() - their_lags)))
    return rows


def resident(*, peak: bool) -> float:
    """MiB of this process in memory, now or at most since it was last asked without ``peak`` (Linux)."""
    if not peak:
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM" if peak else "VmRSS"].split()[0]) / 1024


def phantom(quick: bool) -> dict[str, float]:
    """Seconds for a packet of the phantom's size, and MiB that tracking adds to the process at its peak."""
    shrink = 0.3 if quick else 1.0
    shape = tuple(round(shrink * side / STEP) + 13 for side in reversed(PHANTOM))
    origin = tuple(c - 0.5 * (n - 1) * STEP for c, n in zip(CENTRE, reversed(shape), strict=True))
    grid, generator = Grid(origin, (STEP,) * 3, shape), torch.Generator().manual_seed(0)
    start = time.process_time()
    packet = simulate_packet(LinearFlow((0.3, 0.2, 0.25)), grid, EchoModel(), 0.0, generator)
    simulated = time.process_time() - start
    points = grid.nodes().view(*shape, 3)[6:-6:6, 6:-6:6, 6:-6:6].reshape(-1, 3)
    SpeckleTracker().track(packet, points[:1])  # what is made once per process
    rows = {"nodes": float(np.prod(shape)), "points": float(len(points)), "simulated (s)": simulated}
    for name, some in (("100 points", points[:: max(len(points) // 100, 1)]), ("all points", points)):
        before, start = resident(peak=False), time.process_time()
        SpeckleTracker().track(packet, some)
        rows[f"tracked, {name} (s)"] = time.process_time() - start
        rows[f"memory added, {name} (MiB)"] = resident(peak=True) - before
    rows["simulated and tracked (s)"] = simulated + rows["tracked, all points (s)"]
    rows["packet (MiB)"] = packet.iq.element_size() * packet.iq.numel() / 2**20
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="small volumes, two rounds")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers here")
    arguments = parser.parse_args()
    results = {"threads": torch.get_num_threads()}
    for part in (phantom, rivals):
        results[part.__name__] = part(arguments.quick)
        for name, value in results[part.__name__].items():
            print(f"{part.__name__:8s} {name:62s} {value:12.4g}", flush=True)
    found = results["rivals"]
    for rival, least in (("plain SciPy, direct", 20.0), ("plain SciPy, fft", 20.0), ("OpenPIV", 1.0)):
        ratio = found.get(f"times as fast as {rival}")
        if ratio is not None:
            print(f"{rival}: {ratio:.1f}x, asked for {least:g}x: {'met' if ratio >= least else 'NOT met'}")
    if arguments.json:
        write_table(arguments.json, results, SOURCES)


if __name__ == "__main__":
    main()
