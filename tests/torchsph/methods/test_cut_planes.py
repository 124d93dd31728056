"""Planes cut out of a flow in space, on an exact flow whose divergence in the plane is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import geometry
import torchsph as ts
from geometry import Recording
from torchsph.methods.ensemble.model_error import flow_perturbations
from torchsph.simulator.grid_forecast import GridForecast, Transfer

RATE = np.array([6.0, 8.0])  # 1/s: the velocity is (6 x, 8 y, -14 z), a potential flow, at all times
HALF = np.array([0.008, 0.011])  # m


@pytest.fixture(name="plane", scope="module")
def _plane() -> Recording:
    """The plane z = 0 of that flow within an ellipse that moves with it: closed, and it grows."""
    body, time = geometry.ellipse(tuple(HALF), 0.7e-3, (0.0, 0.0)), np.array([0.0, 0.01, 0.02])
    grid = geometry.Grid((-0.011, -0.015), (1e-3, 1e-3), (31, 23))
    nodes = grid.nodes().numpy()
    stretch = np.exp(RATE * time[:, None])
    masks = [((nodes / (HALF * one)) ** 2).sum(1).reshape(grid.shape) < 1 for one in stretch]
    vertices = np.stack([body.vertices * one for one in stretch])
    return Recording(
        time,
        grid,
        np.stack([(nodes * RATE).T.reshape(2, *grid.shape) * mask for mask in masks]),
        np.stack(masks),
        geometry.Wall(vertices, body.faces, body.region, velocity=vertices * RATE),
        1060.0,
        0.004,
        cut=True,
    )


def error(found: np.ndarray, plane: Recording, frame: int) -> float:
    inside = plane.mask[frame]
    right = plane.velocity[frame][:, inside]
    return float(np.sqrt(np.square(found[:, inside] - right).sum() / np.square(right).sum()))


def forecast(plane: Recording, members: int = 1) -> GridForecast:
    model, start = ts.make_model(plane, spacing=1e-3), torch.from_numpy(plane.velocity[0])
    mask = torch.from_numpy(plane.mask[0].copy())
    start = start if members == 1 else torch.stack([start, 0.5 * start])
    return GridForecast(model, plane.grid, start, mask, 0.0, Transfer(fade=None))


def test_a_forecast_keeps_what_comes_in_through_the_plane(plane: Recording) -> None:
    going = forecast(plane)
    assert float(going.shock) < 0.1
    value, covered = going.at(0.02, torch.from_numpy(plane.mask[2].copy()))
    assert error(value[0].numpy(), plane, 2) < 0.12 and bool(covered[0][torch.from_numpy(plane.mask[2].copy())].all())
    particles, units = going.run.particles, going.run.units
    area = float(particles.mass.sum()) * units.length**2
    assert area == pytest.approx(geometry.WallMotion.from_recording(plane).volume(0.02), rel=0.01)


@pytest.fixture(name="vortex", scope="module")
def _vortex() -> Recording:
    """Hill's vortex (Phil. Trans. R. Soc. A 185 (1894) 213) in the sphere at rest, cut through its axis: steady."""
    radius, speed = 0.01, 0.2
    body = geometry.ellipse((radius, radius), 0.7e-3, (0.0, 0.0))
    grid = geometry.Grid((-0.011, -0.011), (1e-3, 1e-3), (23, 23))
    x, z = grid.nodes().numpy().T.reshape(2, *grid.shape)
    mask = x**2 + z**2 < radius**2
    field = 1.5 * speed / radius**2 * np.stack([x * z, radius**2 - z**2 - 2 * x**2]) * mask
    wall = geometry.Wall(body.vertices, body.faces, body.region)
    return Recording(np.array([0.0, 0.01, 0.02]), grid, np.stack([field] * 3), mask, wall, 1060.0, 0.0, cut=True)


def test_a_vortex_ring_stays_as_it_is(vortex: Recording) -> None:
    """In the plane its divergence is -1.5 U z / a^2; as a plane flow it would be another one."""
    mask = torch.from_numpy(vortex.mask[2].copy())
    cut, flat = (forecast(replace(vortex, cut=one)).at(0.02, mask)[0][0].numpy() for one in (True, False))
    kept, lost = error(cut, vortex, 2), error(flat, vortex, 2)
    assert kept < 0.22 and kept < 0.45 * lost  # .12 are of imposing and fetching at a wall that the flow slides along


def test_members_keep_their_own(plane: Recording) -> None:
    """Two members with fields of their own; the walls ask both for what the closed ellipse takes in."""
    going = forecast(plane, members=2)
    exchange, member = going.run.particles.exchange, going.run.particles.member
    assert exchange is not None
    rates = [float(exchange[member == k].mean()) / going.run.units.time for k in (0, 1)]
    assert rates == pytest.approx([RATE.sum(), RATE.sum()], rel=0.02)


def test_splines_leave_the_divergence_of_a_cut(plane: Recording) -> None:
    noise = np.random.default_rng(0).normal(0, 0.01, plane.velocity.shape) * plane.mask[:, None]
    noisy = replace(plane, velocity=plane.velocity + noise.astype(np.float32), weight=plane.mask)
    cut, flat = (ts.smooth(replace(noisy, cut=one)) for one in (True, False))
    kept, lost = (float(np.mean([error(one.velocity[k], plane, k) for k in range(3)])) for one in (cut, flat))
    assert kept < 0.09 and kept < 0.75 * lost


def test_the_ensemble_takes_nothing_of_it_away(plane: Recording) -> None:
    noise = np.random.default_rng(1).normal(0, 0.01, plane.velocity.shape) * plane.mask[:, None]
    noisy = replace(plane, velocity=plane.velocity + noise.astype(np.float32), weight=plane.mask)
    prepared = ts.PreparedMeasurement(noisy)
    assert prepared.balance is None and not prepared.splines.estimates.contradicted
    found = ts.assimilate(prepared, ts.make_model(noisy, spacing=2e-3), members=4).recording
    assert found.cut and max(error(found.velocity[k], plane, k) for k in range(3)) < 0.12


def test_perturbations_of_a_cut_have_the_divergence_of_isotropic_turbulence() -> None:
    mask = np.ones((120, 120), bool)
    generator = torch.Generator().manual_seed(0)
    field = flow_perturbations(8, mask, (1e-3, 1e-3), 0.1, 3e-3, generator, cut=True)[:, :, 20:-20, 20:-20]
    (du_dy, du_dx), (dv_dy, dv_dx) = (torch.gradient(field[:, k], spacing=1e-3, dim=(1, 2)) for k in (0, 1))
    ratio = (du_dx + dv_dy).square().mean() / (dv_dx - du_dy).square().mean()
    assert float(ratio) == pytest.approx(0.2, rel=0.15)
    # Taylor 1935: <(du/dx)^2> : <(du/dy)^2> = 1 : 2 in isotropic turbulence
    assert float(du_dx.square().mean() / du_dy.square().mean()) == pytest.approx(0.5, rel=0.15)


def test_what_cannot_keep_it_is_refused(plane: Recording) -> None:
    with pytest.raises(ValueError, match=r"cut out of a flow .* needs the incompressible scheme"):
        ts.make_model(plane, preset="weakly_compressible")
    with pytest.raises(ValueError, match="Scene.cut is of planes"):
        ts.Scene(spacing=1e-3, cut=True)
