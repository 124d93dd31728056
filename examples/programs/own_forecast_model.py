"""A forecast model of your own in a filter: any function that moves an ensemble of states.

A swinging pendulum whose angle alone is measured, with an error of 0.3 rad. Prints the RMS error of the angular
velocity, which nobody measures, over its RMS.
"""

import torch

from torchsph.assimilation import ETKF, Multiplicative, Observations

STEP, NOISE = 0.1, 0.3  # s, rad


def pendulum(state: torch.Tensor) -> torch.Tensor:
    """Angle and angular velocity (..., 2) a step later."""
    angle, speed = state.unbind(-1)
    for _ in range(10):
        speed = speed - 0.1 * STEP * 9.81 * torch.sin(angle)
        angle = angle + 0.1 * STEP * speed
    return torch.stack([angle, speed], -1)


def main() -> float:
    draw = torch.Generator().manual_seed(0)
    truth = torch.tensor([1.5, 0.0], dtype=torch.float64)
    ensemble = torch.randn(20, 2, generator=draw, dtype=torch.float64)
    etkf, wrong, right = ETKF(inflation=Multiplicative(1.02)), [], []
    for cycle in range(150):
        truth, ensemble = pendulum(truth), pendulum(ensemble)
        measured = truth[:1] + NOISE * torch.randn(1, generator=draw, dtype=torch.float64)
        observations = Observations(measured, torch.tensor([NOISE**2], dtype=torch.float64))
        analysis = etkf.analyse(ensemble, ensemble[:, :1], observations)
        ensemble = analysis.ensemble
        if cycle >= 50:
            wrong.append((analysis.mean[1] - truth[1]) ** 2)
            right.append(truth[1] ** 2)
    return float((sum(wrong) / sum(right)) ** 0.5)


if __name__ == "__main__":
    print(f"relative error of what was not measured: {main():.3f}")
