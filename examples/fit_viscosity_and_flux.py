"""Viscosity and the flux through an opening, fitted to a noisy measurement by the gradients of a forecast.

    python examples/fit_viscosity_and_flux.py [--noise 0.05] [--frames 4]

A swirl decays in a rigid tube through which fluid is driven: the swirl's decay tells the viscosity, the flow along the
tube the flux. Both start a factor of two off.
"""

from __future__ import annotations

import argparse
import math

import torch

import geometry
from torchsph import Scene, Simulator, Valve, preset
from torchsph.simulator.scene import Fluid

RADIUS, LENGTH, SPACING = 0.01, 0.03, 2.5e-3  # m
VISCOSITY, FLUX, INTERVAL = 0.2, 6e-5, 0.01  # Pa s, m^3/s, s
ALWAYS = ((-1.0, 10.0),)
GRID = geometry.Grid.covering((-RADIUS, -RADIUS, 0.0), (RADIUS, RADIUS, LENGTH), SPACING)
NODES = GRID.nodes()
INSIDE = ((NODES[:, :2].norm(dim=1) < RADIUS).reshape(GRID.shape), NODES[:, :2].square().sum(1) / RADIUS**2)
SCENE = Scene(
    SPACING,
    fluid=Fluid(1060.0, VISCOSITY),
    walls=geometry.WallMotion.at_rest(geometry.tube(RADIUS, LENGTH, 2e-3)),
    valves=(Valve(1, ALWAYS, flux=FLUX), Valve(2, ALWAYS)),
)
MODEL = Simulator(SCENE, preset("default"), dtype=torch.float64, differentiable=True)


def forecasts(factors: torch.Tensor, frames: int) -> torch.Tensor:
    """Velocities (frames, 3, *shape), m/s, at the nodes: ``factors`` (2,) of the viscosity and of the flux."""
    profile = (1 - INSIDE[1]).clamp_min(0.0)
    swirl = 30.0 * profile
    along = factors[1] * 2.0 * FLUX / (math.pi * RADIUS**2) * profile
    start = torch.stack([-swirl * NODES[:, 1], swirl * NODES[:, 0], along]).reshape(3, *GRID.shape)
    run = MODEL.start(0.0, seed=0)
    run.change(viscosity=factors[0] * VISCOSITY, valve_strength=factors[1])
    run.impose(GRID, start, INSIDE[0])
    found = []
    for frame in range(1, frames + 1):
        run.advance(frame * INTERVAL)
        found.append(run.fetch(GRID, INSIDE[0]).value[0])
    return torch.stack(found)


def fitted(noise: float, frames: int, steps: int = 12) -> torch.Tensor:
    """Factors (2,) that fit a measurement whose true ones are 1; ``noise`` in m/s."""
    with torch.no_grad():
        measured = forecasts(torch.ones(2, dtype=torch.float64), frames)
    draw = torch.Generator().manual_seed(0)
    measured = measured + noise * torch.randn(measured.shape, generator=draw, dtype=measured.dtype)
    logarithm = torch.tensor([math.log(2.0), math.log(0.5)], dtype=torch.float64, requires_grad=True)
    search = torch.optim.LBFGS([logarithm], max_iter=steps, line_search_fn="strong_wolfe")

    def misfit() -> torch.Tensor:
        search.zero_grad()
        loss = (forecasts(logarithm.exp(), frames) - measured)[:, :, INSIDE[0]].square().mean() / 0.05**2
        loss.backward()
        print(
            f"misfit {float(loss.detach()):.4f}, viscosity and flux over the true ones",
            logarithm.detach().exp().tolist(),
        )
        return loss

    search.step(misfit)
    return logarithm.detach().exp()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--noise", type=float, default=0.05, help="m/s, standard deviation at each node (0.05)")
    parser.add_argument("--frames", type=int, default=4, help=f"measured frames, {1e3 * INTERVAL:g} ms apart (4)")
    options = parser.parse_args()
    viscosity, flux = fitted(options.noise, options.frames).tolist()
    print(f"viscosity {viscosity * VISCOSITY:.4f} Pa s (true {VISCOSITY}), flux {flux * FLUX:.3e} m^3/s (true {FLUX})")


if __name__ == "__main__":
    main()
