"""Errors on damaged measurements, drawn from the results of `benchmarks/robustness.py`.

python examples/stability_figure.py [--out stability.png]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt

HERE = Path(__file__).resolve().parent
METHODS = {"gaussian": "0.7", "spline": "tab:purple", "ensemble": "tab:blue"}


def main() -> None:
    """A panel for each level of noise, a bar for each method and case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=HERE / "stability.png")
    options = parser.parse_args()
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), sharey=True, layout="constrained")
    found = {}
    for noise in ("measured", "noisy"):
        file = HERE / "benchmarks" / "results" / f"robustness_{noise}.json"
        found[noise] = json.loads(file.read_text(encoding="utf-8"))["cases"]
    order = ["as it is", *sorted({name for cases in found.values() for name in cases} - {"as it is"})]
    for axis, (noise, cases) in zip(axes, found.items(), strict=True):
        for number, (method, colour) in enumerate(METHODS.items()):
            place = np.arange(len(order)) + 0.26 * (number - 1)
            axis.barh(place, [cases.get(name, {}).get(method, 0) for name in order], 0.24, color=colour, label=method)
        axis.set(yticks=range(len(order)), yticklabels=order, xlabel="error / RMS speed", title=f"{noise} phantom")
    axes[0].invert_yaxis()
    axes[0].legend(fontsize=8, loc="lower right")
    figure.savefig(options.out, dpi=80)


if __name__ == "__main__":
    main()
