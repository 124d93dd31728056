"""Files of other labs, each by one command line: what `torchsph convert` and `torchsph info` say of them.

    python examples/real_files.py FOLDER

The folder holds, from GitHub: `aorta_4dflownet` (EdwardFerdian/4DFlowNet, data), `lv_bivme`
(UOA-Heart-Mechanics-Research/biv-me, example/fitted-models as OBJ), `piv` (alexlib/pivpy) and `ptv` (ronshnapp/MyPTV,
smoothed_trajectories). What is not there is passed by. The table of `geometry/formats/README.md` comes from here.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import shlex
import tempfile
from pathlib import Path

from torchsph.cli import main as torchsph

AORTA = "--velocity u,v,w --mask mask --spacing dx --length-unit mm --axes auto"
LINES = {
    "4D flow of an aorta": f"aorta_4dflownet/example_data.h5 {AORTA}",
    "the same at half the spacing": f"aorta_4dflownet/example_data_HR.h5 {AORTA}",
    "endocardium over a beat": "lv_bivme/lv_endocardium_*.obj --length-unit mm --openings 2 --period 0.8 "
    "--grid-spacing 0.004",
    "DaVis": "piv/B00001.txt",
    "OpenPIV": "piv/exp1_001_b.txt --length-unit 2e-5 --velocity-unit 0.01",
    "MyPTV": "ptv/smoothed_trajectories --format tracks --length-unit mm --velocity-unit 0.1 --time-unit 0.01 "
    "--grid-spacing 0.01",
}


def run(arguments: list[str]) -> tuple[int, str]:
    """Exit code of a command and all that it says."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = int(torchsph(arguments) or 0)
    return code, said.getvalue()


def main() -> int:
    """Convert each, look at it, print both; 1 where a file that is there is not converted."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    folder, failed = parser.parse_args().folder, 0
    with tempfile.TemporaryDirectory() as scratch:
        for name, line in LINES.items():
            first, *rest = shlex.split(line)
            files = sorted(folder.glob(first))
            print(f"\n== {name}: torchsph convert {line}")
            if not files:
                print("not there")
                continue
            target = str(Path(scratch) / "converted.h5")
            code, said = run(["convert", *map(str, files), *rest, "--out", target])
            print(said.replace(f"{scratch}/", ""), end="")
            if code == 0:
                code, said = run(["info", target])
                print(said.replace(f"{scratch}/", ""), end="")
            failed += code != 0
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
