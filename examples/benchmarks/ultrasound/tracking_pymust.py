"""What PyMUST images of the scatterers that tests/torchsph/ultrasound/estimation/test_pymust.py gives to our imager.

    pip install pymust
    python examples/benchmarks/ultrasound/tracking_pymust.py --out tests/torchsph/ultrasound/estimation/pymust_plane.npz
        [--quick] [--json FILE]

PyMUST (Garcia, Comput. Methods Programs Biomed. 218, 2022) computes the pressure field of every element of a
linear array in the frequency domain, receives, demodulates and beamforms. Here: an L11-5v, one plane wave,
delay and sum at an f-number of 1.5, around a depth of 20 mm. Written are its image of one point and of
400 scatterers, demodulated at the depth of the sample, and the statistics of its speckle.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import numpy as np
import pymust

from examples.provenance import write_table

SOURCES = ("examples/benchmarks/ultrasound/tracking_pymust.py",)

STEP = (0.1e-3, 0.04e-3)  # x, z, m
SHAPE = (121, 61)
DEPTH = 20e-3


class Scanner:
    """PyMUST's array and the pixels it beamforms."""

    def __init__(self) -> None:
        self.array = pymust.getparam("L11-5v")
        self.array.fs, self.array.bandwidth, self.array.TXnow = 4 * self.array.fc, 60, 2
        self.array.c, self.array.fnumber, self.array.t0 = 1540.0, 1.5, np.zeros(1)
        self.delays = pymust.txdelay(self.array, 0.0)
        x = (np.arange(SHAPE[1]) - SHAPE[1] // 2) * STEP[0]
        z = DEPTH + (np.arange(SHAPE[0]) - SHAPE[0] // 2) * STEP[1]
        self.z, self.x = np.meshgrid(z, x, indexing="ij")
        self.wave = 4 * np.pi * self.array.fc / self.array.c

    def image(self, x: np.ndarray, z: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
        echoes, _ = pymust.simus(x, z, amplitude, self.delays, self.array)
        iq = pymust.rf2iq(echoes, self.array)
        beamformer = pymust.dasmtx(1j * np.array(iq.shape), self.x, self.z, self.delays, self.array)
        return (beamformer @ iq.flatten(order="F")).reshape(SHAPE, order="F") * np.exp(-1j * self.wave * self.z)


def cloud(count: int, seed: int, beyond: float = 0.5e-3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions and amplitudes of scatterers that fill the image and what lies ``beyond`` m around it."""
    random = np.random.default_rng(seed)
    half = beyond + 0.5 * np.array(SHAPE[::-1]) * STEP
    place = random.uniform(-half, half, (count, 2))
    return place[:, 0], DEPTH + place[:, 1], random.choice([-1.0, 1.0], count)


def width(correlation: np.ndarray, step: float) -> float:
    """Full width at half maximum of a curve that starts at its maximum of 1 and is mirrored there."""
    below = int(np.argmax(correlation < 0.5))
    share = (correlation[below - 1] - 0.5) / (correlation[below - 1] - correlation[below])
    return 2 * step * (below - 1 + share)


def speckle(scanner: Scanner, clouds: int) -> dict[str, float]:
    """Contrast (mean over deviation of the magnitude) and widths of the autocorrelation, m."""
    images = np.stack([scanner.image(*cloud(8000, 100 + seed, 1e-3)) for seed in range(clouds)])
    # PyMUST's echoes fade with depth; statistics are those of speckle of equal brightness
    images /= np.sqrt((np.abs(images) ** 2).mean((0, 2), keepdims=True))
    magnitude = np.abs(images)
    curves = []
    for axis, lags in ((1, 20), (2, 20)):
        lines = np.moveaxis(images, axis, -1)
        products = [(lines[..., lag:] * lines[..., : lines.shape[-1] - lag].conj()).mean() for lag in range(lags)]
        curves.append(np.abs(np.array(products)) / abs(products[0]))
    return {
        "contrast": float(magnitude.mean() / magnitude.std()),
        "axial_width": width(curves[0], STEP[1]),
        "lateral_width": width(curves[1], STEP[0]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, help="the reference file for the test")
    parser.add_argument("--quick", action="store_true", help="two images of speckle in place of sixteen")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the statistics here")
    arguments = parser.parse_args()
    scanner = Scanner()
    point = scanner.image(np.zeros(1), np.full(1, DEPTH), np.ones(1)) * np.exp(1j * scanner.wave * DEPTH)
    x, z, amplitude = cloud(400, 0)
    statistics = speckle(scanner, 2 if arguments.quick else 16)
    print(json.dumps(statistics, indent=1))
    if arguments.out:
        np.savez_compressed(
            arguments.out,
            point=point.astype(np.complex64),
            image=scanner.image(x, z, amplitude).astype(np.complex64),
            x=x,
            z=z,
            amplitude=amplitude,
            step=STEP,
            depth=DEPTH,
            frequency=scanner.array.fc,
            sound_speed=scanner.array.c,
            version="PyMUST 0.1.9",
            **statistics,
        )
    if arguments.json:
        write_table(arguments.json, statistics, SOURCES)


if __name__ == "__main__":
    main()
