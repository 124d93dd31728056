"""Figures of examples/benchmarks/ultrasound/tracking.py: errors against what makes them, and the filters' responses.

python examples/benchmarks/ultrasound/tracking_figures.py RESULTS.json --out FOLDER
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from torchsph.ultrasound import FIRFilter, PolynomialFilter

AXES = {
    "speed": "speed (m/s)",
    "angle": "angle to the beam (degrees)",
    "shear": "shear (1/s)",
    "snr": "SNR (dB)",
    "clutter": "clutter over blood (dB)",
    "dropout": "axial speed (m/s), FIR filter",
}
COMPONENTS = ("x (across)", "y (across)", "z (along)")


def draw_errors(results: dict, path: Path) -> None:
    """Deviation (lines), size of the bias (crosses) and share of points lost (grey) of every sweep."""
    figure, axes = plt.subplots(2, 4, figsize=(16, 7), constrained_layout=True)
    for axis, (part, label) in zip(axes.flat, AXES.items(), strict=False):
        rows = results.get(part, {})
        rows = rows.get("FIR", rows)  # of several filters, that of figure 3.3
        places = [float(value) for value, row in rows.items() if "std" in row]
        for component, name in enumerate(COMPONENTS):
            colour = f"C{component}"
            for statistic, style in (("std", "o-"), ("bias", "x")):
                values = [abs(row[statistic][component]) for row in rows.values() if "std" in row]
                axis.semilogy(places, values, style, color=colour, label=f"{statistic} {name}")
        lost = axis.twinx()
        lost.fill_between([float(v) for v in rows], [1 - row["accepted"] for row in rows.values()], color="0.85")
        lost.set(ylim=(0, 1), yticks=[])
        axis.set_zorder(lost.get_zorder() + 1)
        axis.patch.set_visible(False)
        axis.set(xlabel=label, ylabel="m/s", ylim=(2e-5, 0.5))
        axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=7, ncols=2)
    for kernel, row in results.get("memory", {}).items():
        axes[1, 2].plot([float(lag) for lag in row], list(row.values()), "o-", label=f"kernel {kernel}")
    axes[1, 2].set(xlabel="distance (mm)", ylabel="autocorrelation of the lateral error", ylim=(-0.2, 1))
    thirds = results.get("calibration", {})
    for name in ("all", "across", "along"):
        if name in thirds:
            axes[1, 3].plot([1, 2, 3], thirds[name], "o-", label=name)
    axes[1, 3].axhspan(0.8, 1.25, color="0.9")
    axes[1, 3].set(xlabel="third of the weight, least first", ylabel="RMS of z-scores", ylim=(0, 3), xticks=[1, 2, 3])
    for axis in axes[1, 2:]:
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend(fontsize=8)
    figure.suptitle("Speckle tracking errors: std (lines), |bias| (crosses), share of points not accepted (grey)")
    figure.savefig(path, dpi=90)
    plt.close(figure)


def draw_response(path: Path) -> None:
    """Frequency response of the clutter filters (figure 3.3 of the thesis)."""
    frequency = np.linspace(0, 0.5, 501)
    figure, axis = plt.subplots(figsize=(6, 3.6), constrained_layout=True)
    for name, power in (
        ("FIR, 9 taps", FIRFilter().response(frequency)),
        ("polynomial, order 2", PolynomialFilter(2).response(frequency)),
        ("polynomial, order 3", PolynomialFilter(3).response(frequency)),
    ):
        axis.plot(frequency, 10 * np.log10(np.maximum(power, 1e-12)), label=name)
    axis.set(xlabel="frequency / PRF", ylabel="power response (dB)", ylim=(-80, 5), xlim=(0, 0.5))
    axis.grid(alpha=0.3)
    axis.legend()
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("results", type=Path, metavar="RESULTS.json")
    parser.add_argument("--out", type=Path, default=Path("."), metavar="FOLDER")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw_errors(json.loads(arguments.results.read_text()), arguments.out / "tracking.png")
    draw_response(arguments.out / "tracking_clutter_filter.png")


if __name__ == "__main__":
    main()
