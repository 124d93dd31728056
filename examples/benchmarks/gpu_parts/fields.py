"""Speckle tracking and the spline fit on the device."""

from __future__ import annotations

from dataclasses import replace

import torch

import regularize
from geometry import Grid
from torchsph.ultrasound import EchoModel, LinearFlow, SpeckleTracker, simulate_packet

from .bench import Bench

STEP = 1e-3 / 6  # m, between the nodes of a packet
FLOW = LinearFlow((0.3, 0.2, 0.25))


def tracker(bench: Bench) -> None:
    """Vectors a second, all lags, phase and shear, of one packet."""
    side, reach = (26, 6) if bench.fast else (72, 9)
    grid = Grid((-0.5 * (side - 1) * STEP, -0.5 * (side - 1) * STEP, 0.06), (STEP,) * 3, (side,) * 3)
    packet = simulate_packet(FLOW, grid, EchoModel(), 0.0, torch.Generator().manual_seed(0))
    inner = slice(reach, -reach, 6 if bench.fast else 2)
    points = grid.nodes().view(side, side, side, 3)[inner, inner, inner].reshape(-1, 3)
    for tile in (512,) if bench.fast else (512, 4096):
        with bench.attempt(tile=tile):
            moved = replace(packet, iq=packet.iq.to(bench.device))
            options = SpeckleTracker(tile=tile)
            found = options.track(moved, points)
            off = found.velocity.cpu() - FLOW.velocity(points, 0.0)
            taken = bench.seconds(lambda moved=moved, options=options: options.track(moved, points), repeats=2)
            bench.add(
                points=len(points),
                tile=tile,
                seconds=taken,
                vectors_per_s=len(points) / taken,
                rms_error=float(off[torch.isfinite(off)].square().mean().sqrt()),
                memory_gb=bench.memory,
            )


def splines(bench: Bench) -> None:
    """One fit with given options of a frame's samples, and of eight frames at once."""
    for side in (10,) if bench.fast else (24, 32, 40):
        with bench.attempt(samples=side**3):
            generator = torch.Generator().manual_seed(0)
            step = 0.06 / side
            axis = (torch.arange(side, dtype=torch.float64) + 0.5) * step
            points = torch.cartesian_prod(axis, axis, axis)
            velocity = torch.stack([torch.sin(60 * points[:, 1]), torch.cos(50 * points[:, 2]), 0 * points[:, 0]], 1)
            noisy = velocity + 0.1 * torch.randn(velocity.shape, generator=generator, dtype=torch.float64)
            smoother = regularize.Smoother(spacing=(step,) * 3, wall=None, no_slip=None).fixed(no_slip=None)
            given = points.to(bench.device), noisy.to(bench.device)
            where = {"divergence_points": given[0]}
            field = smoother.fit(*given, **where)
            error = float((field(given[0], outside=0.0).cpu() - velocity).norm() / velocity.norm())
            one = bench.seconds(lambda s=smoother, g=given, w=where: s.fit(*g, **w), repeats=2)
            many = given[1].expand(8, *noisy.shape).contiguous()
            eight = bench.seconds(lambda s=smoother, g=given, m=many, w=where: s.fit_many(g[0], m, **w), repeats=2)
            coefficients = field.coefficients.numel()
            bench.add(
                samples=side**3,
                coefficients=coefficients,
                one_fit_s=one,
                eight_at_once_s=eight,
                error=error,
                memory_gb=bench.memory,
            )
