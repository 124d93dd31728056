"""Quantities of planes, against plane flows that are known: Lamb and Oseen's, Poiseuille's, Taylor and Green's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import geometry
from torchsph.haemodynamics import (
    CUT_BEAT_UNITS,
    CUT_UNITS,
    PLANE_BEAT_UNITS,
    PLANE_UNITS,
    Derivatives,
    FlowDomain,
    PlaneQuantities,
    flow_quantities,
    plane_beat_numbers,
    plane_cores,
    swirl,
    vorticity,
)
from torchsph.methods.members.frames import MemberFrame
from torchsph.methods.members.quantities import quantified, with_pressure

RHO, MU = 1060.0, 0.004
RADIUS, CORE, GAMMA = 0.01, 0.004, 0.01  # m, m, m2/s
RADII = (np.arange(20_000) + 0.5) * RADIUS / 20_000


def lamb_oseen(radius):
    return GAMMA / (2 * np.pi * radius) * (1 - np.exp(-((radius / CORE) ** 2)))


def vortex(spacing, centre=(0.0, 0.0)):
    """Two frames of the vortex in a wall that turns with it; a short axis, which meets no opening."""
    time, turn = np.array([0.0, 0.005, 0.01]), lamb_oseen(RADIUS) / RADIUS
    body = geometry.ellipse((RADIUS, RADIUS), 0.5 * spacing, (0.0, 0.0))
    grid = geometry.Grid((-0.0115, -0.0115), (spacing, spacing), (round(0.023 / spacing) + 1,) * 2)
    nodes = grid.nodes().numpy()
    radius = np.maximum(np.linalg.norm(nodes, axis=1), 1e-9)
    mask = (radius < RADIUS).reshape(grid.shape)
    field = (lamb_oseen(radius) / radius)[:, None] * np.stack([-nodes[:, 1], nodes[:, 0]], 1)
    angles = turn * time
    spun = [body.vertices @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) for a in angles]
    drift = [turn * np.stack([-each[:, 1], each[:, 0]], 1) for each in spun]
    wall = geometry.Wall(np.stack(spun), body.faces, body.region, velocity=np.stack(drift))
    velocity = np.stack([field.T.reshape(2, *grid.shape) * mask] * 3)
    return geometry.Recording(time, grid, velocity, np.stack([mask] * 3), wall, RHO, MU)


def exact_vortex():
    """By quadrature over rings."""
    speed, ring = lamb_oseen(RADII), 2 * np.pi * RADII * (RADIUS / len(RADII))
    curl = GAMMA / (np.pi * CORE**2) * np.exp(-((RADII / CORE) ** 2))
    shear = curl - 2 * speed / RADII  # r d(u / r) / dr
    inside = curl > np.abs(shear)
    return {
        "area": np.pi * RADIUS**2,
        "kinetic_energy": RHO / 2 * speed**2 @ ring,
        "energy_loss": MU * shear**2 @ ring,
        "vorticity_rms": np.sqrt(curl**2 @ ring / ring.sum()),
        "circulation_positive": GAMMA * (1 - np.exp(-((RADIUS / CORE) ** 2))),
        "vortex_positive": (curl * inside) @ ring,
        "vortex_positive_area": inside @ ring,
        "wall_shear": MU * abs(shear[-1]),
    }


def test_lamb_oseen_converges():
    exact = exact_vortex()
    off = {}
    for spacing in (1e-3, 0.5e-3):
        recording = vortex(spacing)
        found = flow_quantities(FlowDomain.from_recording(recording), recording.velocity)
        assert set(found) == set(PLANE_UNITS)
        off[spacing] = {name: abs(found[name][1] / value - 1) for name, value in exact.items()}
        assert not found["circulation_negative"].any() and not found["flow_inlet"].any()
        assert np.isnan(found["vortex_positive_depth"]).all() and np.isnan(found["pressure_difference"]).all()
    coarse, fine = off.values()
    size = {spacing: each.pop("vortex_positive_area") for spacing, each in off.items()}  # a count of nodes
    assert size[1e-3] < 0.1 and size[0.5e-3] < 0.05
    assert max(coarse.values()) < 0.06 and max(fine.values()) < 0.02, off
    for name in ("energy_loss", "vorticity_rms"):
        assert fine[name] < 0.4 * coarse[name]


def channel(field, *, cut=False, nodes=20, gap=0.0):
    """A steady flow `field(points) -> (n, 2)` in a square of 1 cm: in through its top, out through its bottom."""
    size = 0.01
    step = size / nodes
    grid = geometry.Grid((-0.5 * step,) * 2, (step, step), (nodes + 2,) * 2)
    points = grid.nodes().numpy()
    mask = ((points > 0) & (points < size)).all(1).reshape(grid.shape)
    corners = size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    wall = geometry.Wall(corners, np.array([[0, 1], [1, 2], [2, 3], [3, 0]]), np.array([2, 0, 1, 0]))
    velocity = np.stack([field(points).T.reshape(2, *grid.shape) * mask] * 3)
    time = np.array([0.0, 0.01, 0.02])
    return geometry.Recording(time, grid, velocity, np.stack([mask] * 3), wall, RHO, MU, cut=cut)


def test_poiseuille_between_plates():
    half, top = 0.005, 0.3

    def flow(points):
        return np.stack([0 * points[:, 0], -top * (1 - ((points[:, 0] - half) / half) ** 2)], 1)

    recording = channel(flow)
    found = flow_quantities(FlowDomain.from_recording(recording), recording.velocity)
    through = 4 / 3 * top * half
    np.testing.assert_allclose(found["flow_inlet"], through, rtol=5e-3)
    np.testing.assert_allclose(found["flow_outlet"], through, rtol=5e-3)
    np.testing.assert_allclose(found["wall_shear"], 2 * MU * top / half, rtol=1e-6)
    np.testing.assert_allclose(found["energy_loss"], 8 / 3 * MU * top**2 / half * 0.01, rtol=5e-3)
    np.testing.assert_allclose(found["speed_rms"], top * np.sqrt(8 / 15), rtol=5e-3)
    shed = 2 * top / half**2 * half**2 / 2 * 0.01  # of either side: the speed in the middle times the length
    np.testing.assert_allclose(found["circulation_negative"], -found["circulation_positive"], rtol=1e-9)
    np.testing.assert_allclose(found["circulation_positive"], shed, rtol=1e-2)
    assert not found["vortex_positive"].any()  # shear turns no path
    domain = FlowDomain.from_recording(recording)
    frame = PlaneQuantities(domain, 0)
    pressure = frame.of(recording.velocity[0], None).pressure
    slope = np.diff(pressure[1:-1, 10]) / domain.grid.spacing[1]
    np.testing.assert_allclose(slope, 2 * MU * top / half**2, rtol=1e-4)  # it falls on the way down


def test_what_passes_the_plane_is_no_flow_through_openings():
    """v = -k y: all that comes in at the top leaves through the plane."""
    rate = 20.0

    def flow(points):
        return np.stack([0 * points[:, 0], -rate * points[:, 1]], 1)

    found = {}
    for cut in (True, False):
        recording = channel(flow, cut=cut)
        found[cut] = flow_quantities(FlowDomain.from_recording(recording), recording.velocity)
    assert set(found[True]) == set(CUT_UNITS)
    np.testing.assert_allclose(found[True]["flow_inlet"], rate * 0.01**2, rtol=0.02)
    np.testing.assert_allclose(found[True]["flow_outlet"], 0.0, atol=0.02 * rate * 0.01**2)
    assert found[False]["flow_inlet"][0] < 0.9 * rate * 0.01**2  # what it would be for a plane flow


def test_taylor_green_has_one_vortex_in_each_cell():
    """Cells of side a = pi / k: paths turn within the diamond between the middles of a cell's sides."""
    side, cells, step = 0.005, (2, 1), 0.0001
    wave = np.pi / side
    grid = geometry.Grid(
        (0.5 * step,) * 2, (step, step), (round(cells[1] * side / step), round(cells[0] * side / step))
    )
    x, y = wave * grid.nodes().numpy().T.reshape(2, *grid.shape)
    field = 0.5 * np.stack([-np.sin(x) * np.cos(y), np.cos(x) * np.sin(y)])
    mask = np.ones(grid.shape, bool)
    gradient = Derivatives(grid, mask).gradient(field)
    positive, negative = plane_cores(vorticity(gradient), swirl(gradient) > 0, grid)
    assert positive is not None and negative is not None
    for core in (positive, negative):
        assert abs(core.circulation) == pytest.approx(0.5 * 2 * np.pi / wave, rel=5e-3)
        assert core.area == pytest.approx(side**2 / 2, rel=2e-2)
    middles = [negative.centre[0], positive.centre[0]]  # psi = -sin x sin y / k: the first cell turns from y to x
    np.testing.assert_allclose(middles, [0.5 * side, 1.5 * side], atol=0.02 * side)
    np.testing.assert_allclose([positive.centre[1], negative.centre[1]], 0.5 * side, atol=0.02 * side)
    assert plane_cores(vorticity(gradient), np.zeros(grid.shape, bool), grid) == (None, None)


def test_paths_turn_where_the_eigenvalues_are_complex():
    generator = np.random.default_rng(0)
    tensor = generator.standard_normal((2, 2, 8, 8))
    eigenvalues = np.linalg.eigvals(np.moveaxis(tensor, (0, 1), (-2, -1)))
    square = np.where(np.abs(eigenvalues[..., 0].imag) > 0, eigenvalues[..., 0].imag ** 2, 0)
    np.testing.assert_allclose(np.maximum(swirl(tensor), 0), square, atol=1e-12)
    with pytest.raises(ValueError, match="that of a plane"):
        swirl(np.zeros((3, 3, 2, 2, 2)))


@pytest.mark.parametrize("cut", [True, False])
def test_members_of_a_plane(cut):
    recording = replace(vortex(1e-3), cut=cut)
    rate = np.zeros_like(recording.velocity[0])

    def frame(number):
        field = recording.velocity[number]
        members = np.stack([0.9 * field, 1.1 * field])
        return MemberFrame(number, field, members, rate, np.stack([rate, rate]), None)

    found = quantified(recording, [frame(number) for number in range(3)])
    alone = flow_quantities(FlowDomain.from_recording(recording), np.stack([0.9 * recording.velocity]))
    for name in set(found.kind.units) - {"vortex_positive_depth", "vortex_negative_depth", "pressure_difference"}:
        np.testing.assert_allclose(found.members[name][0], alone[name][0], rtol=1e-9, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(found.members["kinetic_energy"][1], 1.21 * found.estimate["kinetic_energy"])
    assert set(found.beat()) == set(CUT_BEAT_UNITS if cut else PLANE_BEAT_UNITS) == set(found.beat_bands())
    assert (found.pressure is None) == cut and (with_pressure(recording, found).pressure is None) == cut


def test_numbers_of_a_plane_beat():
    time = np.linspace(0, 0.4, 401)
    filling = np.maximum(np.sin(2 * np.pi * (time - 0.2) / 0.2), 0) * (time >= 0.2)
    curves = {name: np.zeros_like(time) for name in CUT_UNITS} | {
        "area": 6e-4 - 2e-4 * np.sin(np.pi * time / 0.4),
        "flow_inlet": 3e-3 * filling,
        "vortex_negative": -0.01 * np.sin(np.pi * time / 0.4),
        "energy_loss": np.full_like(time, 0.1),
    }
    found = plane_beat_numbers(time, curves)
    assert found["fractional_area_change"] == pytest.approx(1 / 3)
    assert found["inflow"] == pytest.approx(3e-3 * 0.2 / np.pi, rel=1e-3)
    assert found["e_time"] == pytest.approx(0.25, abs=1e-4) and found["energy_lost"] == pytest.approx(0.04)
    assert found["vortex_negative_peak"] == pytest.approx(-0.01) and found["vortex_negative_peak_time"] == 0.2
