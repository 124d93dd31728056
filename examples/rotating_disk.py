"""From channel data in a MATLAB file to velocities: the rotating disk that comes with PyMUST, measured by a scanner.

    python examples/rotating_disk.py PWI_disk.mat

The file lies in `examples/data` of PyMUST's source (`pip download --no-deps --no-binary :all: pymust`): 32 unsteered
plane waves at 10 kHz onto a disk of 2 cm, 128 elements, RF sampled at 4/3 of its 5 MHz. Printed are the rotation that
each component of the velocity says, by least squares over the disk, and what is left beside a solid rotation.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
import torch.nn.functional as F

from geometry import Grid
from torchsph.ultrasound import DelayAndSum, Packet, SpeckleTracker, delay_and_sum, phase_slope, read_channel_data

STEP = 1e-4  # m, of the image
BRIGHT = -14.0  # dB below the brightest: the disk, not what is around it
TRIMMED = 2.5  # median misfits beyond which a point is left out


def image_of(path: str) -> Packet:
    """IQ images, 2.5 cm x 2.5 cm."""
    data = read_channel_data(path)
    return delay_and_sum(data, Grid((-12.5e-3, 10e-3), (STEP, STEP), (251, 251)), DelayAndSum(f_number=1.5))


def tracked(packet: Packet) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 2), m, in the disk and velocities (n, 2), m/s, of accepted estimates."""
    nodes = packet.grid.nodes().reshape(*packet.grid.shape, 2)[10:-10:5, 10:-10:5].reshape(-1, 2)
    power = F.avg_pool2d(packet.iq.abs().square().mean(0)[None, None], 9, 1, 4)[0, 0]
    row, column = packet.grid.locate(nodes).round().long().flip(1).unbind(1)
    points = nodes[10 * torch.log10(power[row, column] / power.max()) > BRIGHT]
    found = SpeckleTracker(clutter=None, kernel=2e-3, min_correlation=0.7, lone_correlation=0.7).track(packet, points)
    kept = found.accepted
    return points[kept].numpy(), found.velocity[kept].double().numpy()


def solid_rotation(places: np.ndarray, velocity: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Rate, rad/s, centre (2,), m, and misfit (n,), m/s, of the solid rotation nearest to velocities."""
    zero, one = np.zeros(len(places)), np.ones(len(places))
    rows = np.concatenate([np.stack([-places[:, 1], one, zero], 1), np.stack([places[:, 0], zero, one], 1)])
    rate, along_x, along_z = np.linalg.lstsq(rows, velocity.T.ravel(), rcond=None)[0]
    fitted = np.stack([along_x - rate * places[:, 1], along_z + rate * places[:, 0]], 1)
    return float(rate), np.array([-along_z, along_x]) / rate, np.linalg.norm(velocity - fitted, axis=1)


def main() -> None:
    """Beamform, track, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("file", help="channel data of MUST or PyMUST")
    packet = image_of(parser.parse_args().file)
    slope = phase_slope(packet)
    print(f"phase along depth: {slope.carriers:.2f} carriers, coherence {slope.coherence:.2f}")
    places, velocity = tracked(packet)
    found = len(places)
    for _ in range(8):
        rate, centre, misfit = solid_rotation(places, velocity)
        near = misfit < max(TRIMMED * float(np.median(misfit)), 1e-3)
        places, velocity = places[near], velocity[near]
    rows = np.concatenate([places, np.ones((len(places), 1))], 1)
    (dux, duz), (dwx, dwz) = np.linalg.lstsq(rows, velocity, rcond=None)[0][:2].T
    rate, centre, misfit = solid_rotation(places, velocity)
    print(f"{len(places)} of {found} estimates, centre at {1e3 * centre[0]:.2f}, {1e3 * centre[1]:.2f} mm")
    print(f"rotation {rate:.2f} rad/s; by the axial component {dwx:.2f}, by the lateral one {-duz:.2f}")
    print(f"they differ by {100 * abs(dwx + duz) / rate:.2f} %; strain {dux:.2f} and {dwz:.2f} 1/s")
    size = np.linalg.norm(places - centre, axis=1) * abs(rate)
    print(f"misfit {100 * np.sqrt((misfit**2).mean() / (size**2).mean()):.1f} % of the RMS speed")


if __name__ == "__main__":
    main()
