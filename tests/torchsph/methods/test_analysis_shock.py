"""How hard an analysis hits the particles: its whole size where the increment is divergent, nothing where it is not."""

import math

import numpy as np
import torch

import geometry
from torchsph import Simulator, preset
from torchsph.data import sample_truth
from torchsph.methods.ensemble.model_error import flow_perturbations
from torchsph.simulator.grid_forecast import GridForecast, Transfer
from torchsph.simulator.scene import Scene

SIZE = 0.3  # of the increments, share of the flow's RMS


def test_a_divergent_increment_is_a_shock_and_one_without_divergence_is_none():
    """Of a gradient the projection takes all, whatever its potential is at the walls (Helmholtz, Weyl 1940)."""
    truth = geometry.read_recording(sample_truth())
    frame, grid = 20, truth.grid
    mask = torch.from_numpy(np.array(truth.mask[frame], bool))
    flow = torch.from_numpy(np.where(truth.mask[frame], truth.velocity[frame], 0.0))
    rms = float(flow[:, mask].square().mean().sqrt())
    wave = math.pi / 0.02
    x, _, z = (wave * grid.nodes()[:, axis].reshape(grid.shape) for axis in range(3))
    gradient = torch.stack([torch.cos(x) * torch.cos(z), torch.zeros_like(x), -torch.sin(x) * torch.sin(z)])
    gradient = torch.where(mask, gradient, 0.0).float()
    gradient *= SIZE * rms / float(gradient[:, mask].square().mean().sqrt())
    draw = torch.Generator().manual_seed(0)
    turning = flow_perturbations(1, mask.numpy(), grid.spacing, SIZE * rms, 3e-3, draw)[0].float()
    model = Simulator(Scene.from_recording(truth, 2.5e-3), preset("default"))
    starts = torch.stack([flow, flow + gradient, flow + turning])
    run = GridForecast(model, grid, starts, mask, float(truth.time[frame]), Transfer())
    calm, hard, soft = run.shock.tolist()
    assert calm < 0.12  # what the particles cannot carry of the flow itself
    assert abs(hard - math.hypot(calm, SIZE)) < 0.15 * SIZE
    assert soft < 1.1 * calm
    plain = GridForecast(model, grid, flow, mask, float(truth.time[frame]), Transfer(projections=0))
    assert torch.isnan(plain.shock).all()
    particles = run.run.particles  # increments change velocities alone: every member has the same mass
    mass = particles.per_member(particles.mass.double(), "sum")
    torch.testing.assert_close(mass, mass[:1].expand(3), rtol=1e-12, atol=0)
