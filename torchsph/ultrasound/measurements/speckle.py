"""A speckle-tracking measurement of a known flow: phantom to echoes to velocities."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from geometry import Recording

from ..estimation.tracking import SpeckleTracker
from .noise import frame_seed
from .scanning import Canvas, ScannerOptions, scanned
from .training import TrainingPlan, calibrate

BRIGHTEST = 6.0  # dB over the mean of blood: brighter kernels are taken for tissue
TRAINING = 0x7EA1  # makes the seed of the calibration's simulations differ from every frame's


@dataclass(frozen=True)
class SpeckleOptions(ScannerOptions):
    """Options of :func:`measure_speckle`: those of the scanner, see :class:`ScannerOptions`, and of the tracker.

    Args:
        kernel: m, side of the kernel.
        search: m/s, greatest speed per component that is searched for.
        training: simulations on which the tracker's confidence is calibrated.
    """

    kernel: float = 1e-3
    search: float = 1.0
    training: int = 48

    def __post_init__(self) -> None:
        super().__post_init__()
        self.tracker()
        self.plan()

    def tracker(self) -> SpeckleTracker:
        """The tracker with this kernel, search range and clutter filter."""
        # a scanner's operator knows about how bright blood is; speckle alone hardly takes a kernel 6 dB above that
        max_snr = self.snr + BRIGHTEST
        return SpeckleTracker(kernel=self.kernel, search=self.search, clutter=self.filter(), max_snr=max_snr)

    def plan(self) -> TrainingPlan:
        """The simulations on which it is calibrated."""
        return TrainingPlan(simulations=self.training)


def measure_speckle(true: Recording, options: SpeckleOptions, seed: int, *, progress: bool = False) -> Recording:
    """What a scanner and a speckle tracker report of a recording: every K-th frame, with ``weight`` and ``sigma``.

    Weight and sigma are fitted on random scenes imaged by the same scanner with other seeds, never on
    ``true``. Flagged estimates have weight and velocity 0.

    Args:
        true: what is measured.
        options: of scanner and tracker.
        seed: of scatterers and noise, >= 0.
        progress: whether to show a bar.

    Raises:
        ValueError: where beam and recording differ in dimension.
    """
    model, tracker = options.echo_model(true.dimension), options.tracker()
    spacing = options.spacing(true.grid)
    generator = torch.Generator(options.device).manual_seed(frame_seed(seed, TRAINING))
    middle = tuple(0.5 * (a + b) for a, b in zip(true.grid.origin, true.grid.upper, strict=True))
    calibration = calibrate(model, tracker, spacing, generator, options.plan(), centre=middle)
    canvas = Canvas(true, list(range(0, true.frames, options.every)))
    # the kernel, the way to the end of the search, and a node to spare
    margin = 0.5 * options.kernel + options.search / options.prf + 2 * max(spacing)
    accepted = total = 0
    for frame, points, packets in scanned(true, options, [model], seed, margin, progress=progress):
        if packets:
            found = tracker.track(packets[0], points)
            beam = model.beams.directions(points).to(found.velocity)
            canvas.paint(frame, found.velocity, calibration.sigma(found, beam), calibration.weight(found, beam))
            accepted, total = accepted + int(found.accepted.sum()), total + len(points)
    share = accepted / total if total else 0.0
    return canvas.recording(
        f"speckle tracking of simulated echoes, {options.summary()}, kernel {options.kernel * 1e3:g} mm, "
        f"accepted {share:.3f}, seed {seed}"
    )
