"""Circulation, rings and plane vortices against Hill's vortex, a thin-cored ring and a Gaussian vortex."""

from __future__ import annotations

import numpy as np
import pytest
from haemodynamics_cases import ball, hill_vortex, hill_vorticity, on_grid, order

import geometry
from torchsph.haemodynamics.circulation import contour_circulation, plane_circulation
from torchsph.haemodynamics.fields.derivatives import Derivatives
from torchsph.haemodynamics.fields.sampling import PlaneSection, plane_section
from torchsph.haemodynamics.vortices import main_vortex, vortex_cores, vortex_ring
from torchsph.haemodynamics.vorticity import lambda2, vorticity

RADIUS, CORE, STRENGTH, CENTRE = 0.6, 0.12, 2.0, np.array([0.05, -0.04, 0.08])
AXIS = np.array([0.36, 0.48, 0.8])


def ring_vorticity(points):
    """A ring of radius R around an axis with a Gaussian core of circulation Gamma."""
    place = points - CENTRE
    height = place @ AXIS
    across = place - height[:, None] * AXIS
    distance = np.linalg.norm(across, axis=1)
    size = STRENGTH / (np.pi * CORE**2) * np.exp(-((distance - RADIUS) ** 2 + height**2) / CORE**2)
    return size[:, None] * np.cross(AXIS, across) / np.maximum(distance, 1e-9)[:, None]


def test_a_ring_is_found_in_place_size_and_strength():
    grid, points, _ = ball(0.06, 1.2)
    everywhere = np.ones(grid.shape, bool)
    ring = vortex_ring(on_grid(grid, ring_vorticity(points), everywhere), everywhere, grid)
    assert ring.centre == pytest.approx(CENTRE, abs=1e-3)
    assert ring.axis == pytest.approx(AXIS, abs=1e-6)
    assert ring.circulation == pytest.approx(STRENGTH, rel=1e-3)
    # the impulse of a core of finite width is that of a ring of radius R^2 + c^2 / 2
    assert ring.radius == pytest.approx(np.sqrt(RADIUS**2 + 0.5 * CORE**2), rel=2e-3)


def test_hills_vortex_as_a_ring_converges():
    """Gamma = 5 U a, and the impulse is 2 pi U a^3: the radius is a sqrt(2 / 5) (Batchelor 1967 sec. 7.2)."""
    spacings, errors = [0.2, 0.1, 0.05], []
    for spacing in spacings:
        grid, points, mask = ball(spacing)
        ring = vortex_ring(on_grid(grid, hill_vorticity(points), mask), mask, grid)
        errors.append(abs(ring.circulation / 5 - 1) + abs(ring.radius / np.sqrt(0.4) - 1))
        assert ring.centre == pytest.approx(np.zeros(3), abs=0.5 * spacing)
    assert errors[-1] < 0.02 and order(spacings, errors) > 0.9


def test_circulation_of_contour_and_plane_agree_with_hills_vortex():
    """The half plane x > 0 of Hill's vortex: Gamma = 5 U a; its border is the axis and the half circle."""
    spacings, errors = [0.2, 0.1, 0.05], []
    for spacing in spacings:
        grid, points, mask = ball(spacing)
        velocity = on_grid(grid, hill_vortex(points), mask)
        angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
        circle = np.stack([0.5 + 0.3 * np.cos(angle), 0 * angle, 0.3 * np.sin(angle)], 1)
        # omega = 7.5 x turns about y: a circle in x, z counter-clockwise has the normal -y, 7.5 integral of x over it
        exact = -7.5 * 0.5 * np.pi * 0.3**2
        errors.append(abs(contour_circulation(velocity, grid, mask, circle) / exact - 1))
        curl = vorticity(Derivatives(grid, mask).gradient(velocity))
        section = plane_section(grid, mask, [0, 0, 0], [1, 0, 0], [0, 0, 1], pixel=0.02)
        both = plane_circulation(curl, grid, mask, section)
        assert both.positive == pytest.approx(5, rel=spacing) and both.negative == pytest.approx(-5, rel=spacing)
        assert both.net == pytest.approx(0, abs=spacing)
    assert order(spacings, errors) > 1.8 and errors[-1] < 0.01


def test_a_contour_outside_is_refused():
    grid, _, mask = ball(0.3)
    with pytest.raises(ValueError, match="outside the blood"):
        contour_circulation(np.zeros((3, *grid.shape)), grid, mask, np.array([[0, 0, 0], [9, 0, 0], [0, 9, 0.0]]))


def test_cores_are_told_apart_and_sorted_by_size():
    field = np.zeros((5, 5, 9))
    field[1:4, 1:4, 0:2] = -1.0
    field[1:4, 1:4, 4:8] = -2.0
    labels, count = vortex_cores(field, np.ones(field.shape, bool), 0.5)
    assert count == 2 and labels[2, 2, 5] == 1 and labels[2, 2, 0] == 2 and labels[0, 0, 0] == 0
    assert vortex_cores(field, np.ones(field.shape, bool), 1.5)[1] == 1


def test_a_hill_vortex_has_one_core_around_its_axis():
    grid, points, mask = ball(0.15)
    gradient = Derivatives(grid, mask).gradient(on_grid(grid, hill_vortex(points), mask))
    labels, count = vortex_cores(lambda2(gradient), mask)
    assert count == 1 and labels.max() == 1


def gaussian_section(pixel):
    """A Gaussian vortex at (.2, .3) in a disc of radius 1: u_theta = Gamma / (2 pi r) (1 - exp(-r^2 / c^2))."""
    ticks = np.arange(-1 + 0.5 * pixel, 1, pixel)
    s, t = np.meshgrid(ticks, ticks)
    x, y, core = s - 0.2, t - 0.3, 0.25
    square = x**2 + y**2
    spin = 1 / (2 * np.pi * square) * (1 - np.exp(-square / core**2))
    slope = np.exp(-square / core**2) / (np.pi * core**2) - 2 * spin  # r d(spin)/dr
    gradient = np.array(
        [
            [-slope * x * y / square, -spin - slope * y * y / square],
            [spin + slope * x * x / square, slope * x * y / square],
        ]
    )
    unit = np.eye(3)
    return PlaneSection(np.zeros(3), unit[0], unit[1], ticks, ticks, s**2 + t**2 < 1), gradient


def test_the_numbers_of_a_plane_vortex():
    """Q > 0 inside r = 1.1209 c, where u_theta is highest; the circulation inside is 1 - exp(-1.2564)."""
    section, gradient = gaussian_section(0.01)
    found = main_vortex(gradient, section)
    radius = 0.25 * np.sqrt(1.2564)
    assert found.centre == pytest.approx([0.2, 0.3], abs=1e-3)
    assert found.area == pytest.approx(radius**2, rel=0.02)
    assert found.depth == pytest.approx((1 - 0.3) / 2, abs=0.01)
    assert found.length == pytest.approx(radius, rel=0.03) and found.width == pytest.approx(radius, rel=0.03)
    assert found.intensity == pytest.approx(1 - np.exp(-1.2564), rel=0.02)
    assert found.sphericity == pytest.approx(1, rel=0.05)
    assert main_vortex(-gradient, section).intensity == pytest.approx(-found.intensity)


def test_strain_has_no_vortex():
    section, gradient = gaussian_section(0.1)
    assert main_vortex(np.zeros_like(gradient), section) is None


def test_a_plane_section_knows_its_area():
    grid, _, mask = ball(0.05)
    whole = plane_section(grid, mask, [0, 0, 0.3], [1, 0, 0], [0.3, 1, 0])
    assert whole.area == pytest.approx(np.pi * (1 - 0.09), rel=0.02)
    assert whole.normal == pytest.approx([0, 0, 1])
    part = plane_section(grid, mask, [0, 0, 0.3], [1, 0, 0], [0, 1, 0], radius=0.4)
    assert part.area == pytest.approx(np.pi * 0.16, rel=0.02)
    with pytest.raises(ValueError, match="span no plane"):
        plane_section(grid, mask, [0, 0, 0], [1, 0, 0], [2, 0, 0])
    plane = geometry.Grid((0.0, 0.0), (1.0, 1.0), (3, 3))
    with pytest.raises(ValueError, match="its own plane"):
        plane_section(plane, np.ones((3, 3)), [0, 0], [1, 0], [0, 1])
