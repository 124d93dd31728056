"""What a GPU makes of torchsph: every measurement that one needs, in one run of under eight minutes.

    python examples/benchmarks/gpu.py [--device cuda] [--out gpu-results] [--parts NAME ...] [--seconds 460]
    python examples/benchmarks/gpu.py --device cpu --fast

Needs the package, its tests' pytest, and no network; Triton, which comes with torch's CUDA builds, compiles what has to
be compiled. Each part runs in a process of its own with a limit of time: one that fails, hangs or breaks the device
costs nothing but its own rows. What a part has measured is kept even if it does not end. After each part
``gpu.json`` holds all rows so far; at the end come ``gpu.txt``, a table, and ``gpu.png``, both with the device's name.
``--fast`` makes every part tiny, to try the script; its numbers say nothing.

    machine   what the device does with memory and multiply-adds
    tests     the tests that run on a GPU
    pairs     pair sums at 57 and at 268 neighbours, in particles and pairs a second, and the search
    steps     full steps of 5.0 million particles at 268 neighbours, and of the dam break of sph-benchmarks
    members   1 to 64 members of a ventricle at 1 and .7 mm, against real time
    cycle     the parts of an ensemble's cycle
    tracker   speckle tracking in vectors a second
    splines   the spline fit of a frame

The dam break is that of github.com/tomashalada/sph-benchmarks (SPHERIC's second test, delta-SPH, Wendland C2,
h = 2 spacings, spacing 6 mm), which took TNL-SPH 12.5 ms a step on an H100 SXM and DualSPHysics 5.2 14.5 ms (results of
10 April 2025). Their 4.99 million particles hold 3.13 million of fluid; the others make the walls, which are
tables here. So milliseconds a step compare, and particles a second do where all are fluid (the periodic box).
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve()
ROOT = HERE.parents[2]
PHANTOM = ROOT.parent / "shared" / "data" / "lv_phantom_a.h5"
# part -> seconds that it may take; the sum stays below eight minutes, and what a part leaves the later ones may use
LIMITS = {
    "machine": 30,
    "pairs": 50,
    "steps": 100,
    "members": 110,
    "tests": 60,
    "cycle": 50,
    "tracker": 25,
    "splines": 35,
}
SLOW_MACHINE = 5.0  # with ``--fast``, which is tried where processors are few and busy, the limits are so much longer
LONGEST_TEXT = 3000  # characters kept of what a failed part said


def run_part(name: str, options: argparse.Namespace, limit: float) -> dict[str, object]:
    """Rows of a part, how it ended and how long it took."""
    rows = options.out / f"{name}.jsonl"
    rows.unlink(missing_ok=True)
    command = [sys.executable, str(HERE), "--child", name, "--device", options.device, "--out", str(options.out)]
    command += ["--recording", str(options.recording), *(["--fast"] if options.fast else [])]
    began = time.monotonic()
    with (options.out / f"{name}.log").open("w+") as log:
        child = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True, cwd=ROOT)
        try:
            code = child.wait(timeout=limit)
            ended = "done" if code == 0 else f"failed with exit code {code}"
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
            ended = f"stopped after its {limit:.0f} s"
        log.seek(0)
        said = log.read()
    result: dict[str, object] = {"ended": ended, "seconds": time.monotonic() - began, "rows": read_rows(rows)}
    return result if ended == "done" else result | {"said": said[-LONGEST_TEXT:]}


def read_rows(path: Path) -> list[dict[str, object]]:
    """The rows that a part has left; its last line may be cut where it was stopped."""
    text = path.read_text() if path.exists() else ""
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def child(name: str, options: argparse.Namespace) -> None:
    """One part, in this process."""
    sys.path.insert(0, str(ROOT))
    from gpu_parts import PARTS
    from gpu_parts.bench import Bench

    with (options.out / f"{name}.jsonl").open("w") as rows:
        PARTS[name](Bench(options.device, options.fast, options.recording, rows))


def table(report: dict[str, dict]) -> str:
    """All rows as text."""
    lines = [f"torchsph on {device_name(report)}"]
    for name, part in report.items():
        lines.append(f"\n{name}: {part['ended']}, {part['seconds']:.0f} s")
        for row in part["rows"]:
            shown = (
                f"{key} {value:.5g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()
            )
            lines.append("    " + ", ".join(shown))
        if "said" in part:
            last = [line for line in part["said"].splitlines() if line.strip()][-1:]
            lines.append("    " + (last[0] if last else "without a word"))
    return "\n".join(lines) + "\n"


def device_name(report: dict[str, dict]) -> str:
    """As the first part found it."""
    rows = report.get("machine", {}).get("rows", [])
    return next((str(row["device"]) for row in rows if "device" in row), "a device that did not say its name")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--fast", action="store_true", help="every part tiny: tries the script, measures nothing")
    parser.add_argument("--out", type=Path, default=Path("gpu-results"), metavar="DIR")
    parser.add_argument("--parts", nargs="+", choices=list(LIMITS), default=list(LIMITS))
    parser.add_argument("--seconds", type=float, help="for all parts together; 460, but with --fast 2300")
    parser.add_argument("--recording", type=Path, default=PHANTOM, help="a ventricle; the sample where it is missing")
    parser.add_argument("--child", choices=list(LIMITS), help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.out = options.out.resolve()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.child:
        child(options.child, options)
        return
    report: dict[str, dict] = {}
    seconds = options.seconds or 460.0 * (SLOW_MACHINE if options.fast else 1.0)
    end, spare = time.monotonic() + seconds, 0.0
    for name in options.parts:
        limit = min(LIMITS[name] * (SLOW_MACHINE if options.fast else 1.0) + spare, end - time.monotonic())
        if limit < 1.0:
            report[name] = {"ended": "left out: no time", "seconds": 0.0, "rows": []}
        else:
            report[name] = run_part(name, options, limit)
        spare = max(0.0, limit - report[name]["seconds"])
        (options.out / "gpu.json").write_text(json.dumps(report, indent=1))
        print(f"{name:8s} {report[name]['ended']}, {len(report[name]['rows'])} rows", file=sys.stderr, flush=True)
    (options.out / "gpu.txt").write_text(table(report))
    print(table(report), end="")
    try:
        from gpu_parts.pictures import draw

        draw(report, device_name(report), options.out / "gpu.png")
    except Exception as error:  # numbers without a picture are worth having
        print(f"no picture: {type(error).__name__}: {error}", file=sys.stderr)


if __name__ == "__main__":
    main()
