"""A Doppler measurement of a known flow: phantom to echoes to velocities along one beam, or vectors from several."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from geometry import Recording

from ..acquisition import Beams
from ..estimation.doppler import ColourDoppler, colour_doppler, vector_doppler
from .scanning import Canvas, ScannerOptions, scanned


@dataclass(frozen=True)
class DopplerOptions(ScannerOptions):
    """Options of :func:`measure_doppler`: those of the scanner, see :class:`ScannerOptions`, and two of its own.

    Args:
        window: m, side of the window that is averaged over.
        steering: ``None`` for colour Doppler along one beam; an angle in degrees for vector Doppler from beams
            tilted by it to both sides along every lateral axis.
    """

    window: float = 1e-3
    steering: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        ColourDoppler(self.window)
        if self.steering is not None and not 0 < self.steering < 80:
            raise ValueError(f"steering must lie between 0 and 80 degrees, got {self.steering!r}")
        if self.steering is not None and self.apex is not None:
            raise ValueError("vector Doppler steers parallel beams; give steering or apex, not both")

    def beams(self, dimension: int) -> list[Beams]:
        """The beams that are sent, one after the other."""
        centre = self.echo_model(dimension).beams
        if self.steering is None:
            return [centre]
        tilt = math.radians(self.steering)
        return [
            Beams(tuple(c + sign * math.tan(tilt) * a for c, a in zip(centre.direction, side, strict=True)))
            for side in centre.across()
            for sign in (-1, 1)
        ]


def measure_doppler(true: Recording, options: DopplerOptions, seed: int, *, progress: bool = False) -> Recording:
    """What a scanner's Doppler reports of a recording: every K-th frame, with ``weight`` (coherence) and ``sigma``.

    Args:
        true: what is measured.
        options: of the scanner and the estimate.
        seed: of scatterers and noise, >= 0.
        progress: whether to show a bar.

    Returns:
        By colour Doppler a recording with ``beam`` and ``nyquist``, its velocity (v . b) b; by vector Doppler one of
        full vectors.
    """
    base = options.echo_model(true.dimension)
    models = [replace(base, beams=beams) for beams in options.beams(true.dimension)]
    doppler = ColourDoppler(options.window, options.filter())
    canvas = Canvas(true, list(range(0, true.frames, options.every)))
    for frame, points, packets in scanned(true, options, models, seed, options.window, progress=progress):
        if not packets:
            continue
        found = [colour_doppler(packet, points, doppler) for packet in packets]
        if options.steering is None:
            velocity = found[0].speed[:, None] * base.beams.directions(points).to(found[0].speed)
            sigma = found[0].sigma[:, None].expand(-1, true.dimension)
        else:
            directions = found[0].speed.new_tensor([model.beams.direction for model in models])
            speeds, sigmas = (torch.stack([getattr(f, name) for f in found]) for name in ("speed", "sigma"))
            velocity, sigma = vector_doppler(directions, speeds, sigmas)
        accepted = torch.stack([f.accepted for f in found]).all(0)
        coherence = torch.stack([f.coherence for f in found]).amin(0)
        canvas.paint(frame, velocity, sigma, torch.where(accepted, coherence, 0))
    kind = "colour Doppler" if options.steering is None else f"vector Doppler, {options.steering:g} degrees"
    measured = canvas.recording(
        f"{kind} of simulated echoes, {options.summary()}, window {options.window * 1e3:g} mm, seed {seed}",
        base.beams if options.steering is None else None,
    )
    if options.steering is not None:  # the least squares of several beams do not wrap at any one speed
        return measured
    return replace(measured, nyquist=np.full(measured.frames, base.acquisition.aliasing_speed))
