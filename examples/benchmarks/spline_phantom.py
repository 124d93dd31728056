"""Error of spatial smoothers on measurements whose truth is known, everything chosen automatically.

    python examples/benchmarks/spline_phantom.py TRUTH.h5 MEASURED.h5 [MEASURED.h5 ...] [--every 4]
                                                 [--pymust PYTHON] [--json FILE]

Methods: the measurement as it is, weighted Gaussian smoothing of 3 mm full width at half maximum, the
thesis's spline preset (table 4.1), PyMUST's ``smoothn`` (robust, generalised cross-validation, weights squared;
D. Garcia, Comput. Stat. Data Anal. 54 (2010) 1167), and this package's spline as it comes, frame by frame and averaged
over time (Gaussian of 10 ms). No method sees the truth. The slow rivals take every so manieth frame, and rows that end
in "same frames" are scored on these; all others on every frame. ``--pymust`` names a Python that has PyMUST where this
one has not.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

import geometry
import regularize
from examples.provenance import SPLINES, write_table
from torchsph.evaluation.frames import matching_frames
from torchsph.methods.measurement.frame_splines import FrameSmoother, node_weights

SOURCES = ("examples/benchmarks/spline_phantom.py", *SPLINES)

WIDTH = 3e-3  # m, full width at half maximum of the Gaussian
BLUR = 10e-3  # s, standard deviation of the average over time
FAST = 0.1  # of the highest true speed: slower nodes have no direction worth scoring
PYMUST = """
import sys
import numpy as np
from pymust import smoothn
file = np.load(sys.argv[1])
velocity, weight = file["velocity"], file["weight"]
groups = [[0, 1, 2]] if sys.argv[3] == "together" else [[0], [1], [2]]
out = np.zeros_like(velocity)
for frame, w, found in zip(velocity, weight, out):
    for group in groups:
        found[group] = smoothn([frame[k] for k in group], W=w.copy(), isrobust=True)[0]
np.save(sys.argv[2], out)
"""


def gaussian(velocity: np.ndarray, weight: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Normalised convolution of (D, *shape) with weights (*shape)."""
    sigma = WIDTH / 2.3548 / np.asarray(spacing)[::-1]
    share = gaussian_filter(weight, sigma)
    parts = [gaussian_filter(np.nan_to_num(part) * weight, sigma) for part in velocity]
    return np.stack([np.where(share > 1e-9, part / np.maximum(share, 1e-9), 0.0) for part in parts])


def smoothn(measured: geometry.Recording, frames: list[int], python: str, mode: str) -> np.ndarray | None:
    """(frames, D, *shape) from PyMUST in the interpreter ``python``; None, with a message, where it lacks PyMUST.

    ``mode`` "together": the components share smoothness and robust weights, as PyMUST has it for vectors; "each": they
    do not.
    """
    if subprocess.run([python, "-c", "import pymust"], capture_output=True, check=False).returncode:
        print(f"{python} has no PyMUST: smoothn is left out (pip install pymust, or --pymust PYTHON)", file=sys.stderr)
        return None
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "given.npz", Path(folder) / "found.npy"
        velocity = np.nan_to_num(measured.velocity[frames]).astype(np.float64)
        weight = np.stack([node_weights(measured, frame).astype(np.float64) ** 2 for frame in frames])
        np.savez(given, velocity=velocity, weight=weight)
        subprocess.run([python, "-c", PYMUST, str(given), str(found), mode], check=True, capture_output=True)
        return np.load(found)


class Splines:
    """Fits of some frames of a measurement, on its nodes, and what their analytic derivatives say."""

    def __init__(self, measured: geometry.Recording, smoother: regularize.Smoother) -> None:
        self.frames = FrameSmoother(measured, smoother)
        self.divergence = self.gradient = 0.0

    def __call__(self, frame: int) -> np.ndarray:
        fitted = self.frames.fit(frame)
        mask = torch.from_numpy(np.array(self.frames.recording.mask[frame], bool).reshape(-1))
        gradient = fitted.gradient(self.frames.nodes[mask], outside=0.0)
        self.divergence += float(gradient.diagonal(dim1=1, dim2=2).sum(1).square().sum())
        self.gradient += float(gradient.square().sum())
        return self.frames.on_grid(fitted, frame)

    @property
    def divergence_share(self) -> float:
        """RMS of the divergence over RMS of the gradient."""
        return (self.divergence / self.gradient) ** 0.5


def over_time(fields: np.ndarray, mask: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Average over the frames (F, D, *shape) in which a node lies in the mask (F, *shape)."""
    kernel = np.exp(-0.5 * ((times[:, None] - times) / BLUR) ** 2)
    share = np.einsum("fg,g...->f...", kernel, mask.astype(float))
    total = np.einsum("fg,gd...->fd...", kernel, fields * mask[:, None])
    return total / np.maximum(share, 1e-9)[:, None]


def scores(field: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> dict:
    """NRMSE and mean direction error (degrees) of (F, D, *shape) over the mask (F, *shape)."""
    v, u = (np.moveaxis(each, 1, -1)[mask].astype(np.float64) for each in (field, truth))
    speed = np.linalg.norm(u, axis=1)
    fast = speed > FAST * speed.max()
    cosine = (v * u).sum(1)[fast] / np.maximum(np.linalg.norm(v, axis=1)[fast] * speed[fast], 1e-12)
    return {
        "nrmse": float(np.sqrt(((v - u) ** 2).sum() / (u**2).sum())),
        "direction_error_deg": float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()),
    }


def calibration(truth: geometry.Recording, measured: geometry.Recording, frames: list[int]) -> dict:
    """Root mean square of (fit - truth) / std per component over the mask of some frames.

    As it comes, and with the tracker's resolution cell (as wide as the Gaussian above) told besides; "of the blurred
    truth": of what a tracker of that cell can see at all.
    """
    splines, total = FrameSmoother(measured, regularize.Smoother.preset("default")), []
    for frame in frames:
        fitted, mask = splines.fit(frame, uncertainty=True), np.array(truth.mask[frame], bool)
        points = splines.nodes[torch.from_numpy(mask.reshape(-1))]
        blurred = gaussian(truth.velocity[frame], mask.astype(float), measured.grid.spacing)
        off = [fitted(points).numpy() - each[:, mask].T for each in (truth.velocity[frame], blurred)]
        std, wide = fitted.std(points).numpy(), fitted.std(points, blur=WIDTH).numpy()
        total.append([np.square(z).mean(0) for z in (off[0] / std, off[0] / wide, off[1] / std)])
    names = ("z", "z_with_blur", "z_of_the_blurred_truth")
    return dict(zip(names, np.sqrt(np.mean(total, axis=0)).tolist(), strict=True))


class Table:
    """Rows of a comparison with the truth, printed as they come."""

    def __init__(self, truth: geometry.Recording) -> None:
        self.truth, self.rows = truth, []

    def add(self, name: str, field: np.ndarray, frames: list[int], seconds: float, **more: object) -> None:
        """Score (F, D, *shape) at the frames that it holds; ``seconds`` for all of them."""
        mask, right = np.asarray(self.truth.mask[frames], bool), self.truth.velocity[frames]
        row = {"method": name, "frames": len(frames), **scores(np.nan_to_num(field), right, mask)}
        self.rows.append(row | {"seconds_per_frame": seconds / len(frames), **more})
        line = "  {method:30s} {frames:3d} frames  NRMSE {nrmse:.3f}  direction {direction_error_deg:.1f} deg"
        print(line.format(**row), flush=True)


def compare(truth: geometry.Recording, measured: geometry.Recording, every: int, python: str) -> list[dict]:
    """One row per method."""
    truth = truth.select(matching_frames(measured.time, truth.time, "the truth"))
    frames, few = list(range(measured.frames)), list(range(0, measured.frames, every))
    table = Table(truth)
    table.add("measured", measured.velocity[frames], frames, 0.0)
    start = time.process_time()
    weight = [node_weights(measured, f).astype(np.float64) for f in frames]
    smooth = [gaussian(measured.velocity[f], w, measured.grid.spacing) for f, w in zip(frames, weight, strict=True)]
    smooth = np.stack(smooth)
    table.add("Gaussian, 3 mm", smooth, frames, time.process_time() - start)
    start, fit = time.process_time(), Splines(measured, regularize.Smoother.preset("default"))
    fields = np.stack([fit(frame) for frame in frames])
    seconds, choices = time.process_time() - start, [fit.frames.choice(frame) for frame in frames]
    more = {
        "divergence_share": fit.divergence_share,
        "curvature_mm": [1e3 * choice.curvature for choice in choices],
        "noise_m_s": [list(choice.noise) for choice in choices],
        "no_slip": [choice.no_slip for choice in choices],
        "shared": [choice.shared for choice in choices],
    }
    more |= calibration(truth, measured, few)
    table.add("spline", fields, frames, seconds, **more)
    averaged = over_time(fields, np.asarray(truth.mask[frames], bool), measured.time)
    table.add("spline, 10 ms average", averaged, frames, seconds)
    table.add("Gaussian, same frames", smooth[few], few, 0.0)
    table.add("spline, same frames", fields[few], few, seconds * len(few) / len(frames))
    start, fit = time.process_time(), Splines(measured, regularize.Smoother.preset("thesis"))
    fields = np.stack([fit(frame) for frame in few])
    share = fit.divergence_share
    table.add("thesis preset, same frames", fields, few, time.process_time() - start, divergence_share=share)
    for mode in ("together", "each"):
        start = time.perf_counter()
        found = smoothn(measured, few, python, mode)
        if found is not None:
            table.add(f"PyMUST, {mode}, same frames", found, few, time.perf_counter() - start)
    return table.rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("truth", type=Path)
    parser.add_argument("measured", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=4, help="the slow rivals take every so manieth frame")
    parser.add_argument("--pymust", default=sys.executable, help="a Python that has PyMUST")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    truth, found = geometry.read_recording(options.truth), {}
    for path in options.measured:
        print(path.name)
        found[path.name] = compare(truth, geometry.read_recording(path), options.every, options.pymust)
    if options.json:
        write_table(options.json, found, SOURCES)


if __name__ == "__main__":
    main()
