"""A ventricle whose outlet does not close: how much comes back through it is found from noisy velocities.

    python examples/aortic_regurgitation.py

The ellipsoid of ``torchsph.validation`` fills through its inlet (region 1) and, by a quarter of dV/dt, back through its
outlet (region 2). A simulation with that flux given stands for the blood; what sees its velocities knows of the leak
only that both openings are open.
"""

import numpy as np
import torch

import geometry
import torchsph as ts
from torchsph.evaluation.metrics import evaluate
from torchsph.haemodynamics.flow_rate import OpeningFlow
from torchsph.ultrasound import NoiseModel, measure_noise
from torchsph.validation.ellipsoid import LEAK, OPENING, PulsatingEllipsoid

SHARE = 0.25  # of dV/dt that comes back through the outlet
STEP = 1.5e-3  # m, of the grid and the particles


def truth(body: PulsatingEllipsoid) -> geometry.Recording:
    """Filling from rest, every 10 ms, by a simulation that is told the regurgitant flux."""
    motion, at = body.motion(1.2e-3), body.period * np.linspace(0.5, 0.9, 9)
    grid = geometry.Grid.covering((-0.009, -0.009, -0.011), (0.009, 0.009, 0.010), STEP)
    masks = np.stack([geometry.grid_winding(grid, motion.vertices(t), motion.faces) > 0 for t in at])
    valves = (
        ts.Valve(OPENING, ((0.0, 1.0),)),
        ts.Valve(LEAK, ((0.0, 1.0),), flux=lambda t: SHARE * body.volume_rate(t)),
    )
    run = ts.Simulator(ts.Scene(STEP, walls=motion, valves=valves), ts.preset("default")).start(at[0], seed=0)
    field = np.zeros((len(at), 3, *grid.shape), np.float32)
    for frame, time in enumerate(at):
        run.advance(float(time))
        field[frame] = run.fetch(grid, torch.from_numpy(masks[frame])).value[0].numpy()
    stack, speed = (np.stack([of(t) for t in at]) for of in (motion.vertices, motion.velocity))
    wall = geometry.Wall(stack, motion.faces, motion.region, speed)
    both = np.array([[OPENING, 0.0, 1.0], [LEAK, 0.0, 1.0]])
    return geometry.Recording(at, grid, field, masks, wall, 1060.0, 4e-3, valve_intervals=both)


def share_through_outlet(recording: geometry.Recording, body: PulsatingEllipsoid) -> float:
    """Volume through the outlet over the whole that came in."""
    sampler, time = geometry.WallSampler(geometry.WallMotion.from_recording(recording), 0.5 * STEP), recording.time
    flux = [
        float(OpeningFlow(recording.grid, mask, sampler.at(float(t)), LEAK, [OPENING]).rate(field))
        for t, mask, field in zip(time, recording.mask, recording.velocity, strict=True)
    ]
    return float(np.trapezoid(flux, time) / (body.volume(time[-1]) - body.volume(time[0])))


if __name__ == "__main__":
    body = PulsatingEllipsoid(leak=SHARE)
    true = truth(body)
    rms = float(np.sqrt(np.mean(true.velocity[np.broadcast_to(true.mask[:, None], true.velocity.shape)] ** 2)))
    noise = NoiseModel(lateral=0.3 * rms, axial=0.1 * rms, outliers=0.0, dropout=0.0, clutter=None)
    measured = measure_noise(true, noise, seed=0)
    found = ts.run_methods(measured, ("spline", "ensemble"), members=8)
    for name, one in {"true": true, "measured": measured, **{k: v.recording for k, v in found.items()}}.items():
        score = evaluate(one, true)["nrmse"].value
        print(f"{name:9} error {score:.3f}, through the outlet {share_through_outlet(one, body):.3f} of {SHARE}")
