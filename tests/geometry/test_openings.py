"""Openings of open surfaces: area, centre and normal of known cuts, labels, holes told from openings."""

from dataclasses import replace

import numpy as np
import pytest

import geometry
from geometry import Surface, SurfaceError
from geometry.surfaces.openings import openings, with_lids


def cut(surface, *planes):
    """Without the faces whose centroid lies beyond any plane (point, outward normal)."""
    keep = np.ones(len(surface.faces), bool)
    for point, normal in planes:
        keep &= (surface.centroids - np.asarray(point)) @ np.asarray(normal) < 0
    return Surface(surface.vertices, surface.faces[keep], surface.region[keep])


@pytest.fixture(name="tube")
def _tube():
    closed = geometry.tube(0.01, 0.05, 0.0015)
    return Surface(closed.vertices, closed.faces[closed.region == 0], closed.region[closed.region == 0])


def test_both_ends_of_a_tube(tube):
    found = openings(tube)
    assert len(found) == 2 and not any(one.hole for one in found)
    for one in found:
        assert one.area == pytest.approx(np.pi * 0.01**2, rel=0.02)
        assert one.roundness > 0.95
        end = 0.05 if one.centre[2] > 0.025 else 0.0
        np.testing.assert_allclose(one.centre, [0, 0, end], atol=1e-9)
        np.testing.assert_allclose(one.normal, [0, 0, 1 if end else -1], atol=1e-9)


def test_lids_close_it_with_labels_by_nearest_point(tube):
    closed = with_lids(tube, {4: (0, 0, 0.06), 9: (0, 0, -0.01)})
    closed.check()
    assert closed.volume == pytest.approx(np.pi * 0.01**2 * 0.05, rel=0.02)
    assert closed.centroids[closed.region == 4][:, 2] == pytest.approx(0.05)
    assert closed.centroids[closed.region == 9][:, 2] == pytest.approx(0.0)


def test_lids_by_size_and_the_sense_of_faces_does_not_matter():
    ball = cut(geometry.ellipsoid((0.03, 0.03, 0.03), 0.003), ((0, 0, 0.02), (0, 0, 1)), ((0.026, 0, 0), (1, 0, 0)))
    for surface in (ball, replace(ball, faces=ball.faces[:, ::-1])):
        closed = with_lids(surface)
        closed.check()
        assert closed.volume > 0
        top, side = (closed.centroids[closed.region == label].mean(0) for label in (1, 2))
        assert top[2] > 0.015 and side[0] > 0.02


def test_holes_of_a_torn_wall_are_told_from_openings(tube):
    torn = np.ones(len(tube.faces), bool)
    middle = np.argmin(np.linalg.norm(tube.centroids - [0.01, 0, 0.025], axis=1))
    torn[middle] = False
    found = openings(Surface(tube.vertices, tube.faces[torn], tube.region[torn]))
    assert [one.hole for one in found] == [False, False, True]
    closed = with_lids(Surface(tube.vertices, tube.faces[torn], tube.region[torn]), [1, 2])
    closed.check()
    assert sorted(np.unique(closed.region)) == [0, 1, 2]


def test_a_closed_surface_has_none():
    assert openings(geometry.tube(0.01, 0.05, 0.0015)) == []


def test_wrong_labels_are_refused(tube):
    with pytest.raises(SurfaceError, match="3 openings were labelled, but the surface has 2: 3.1. cm2 at"):
        with_lids(tube, [1, 2, 3])
    with pytest.raises(SurfaceError, match="labels 1 and 2 are nearest to the same opening"):
        with_lids(tube, {1: (0, 0, 0.06), 2: (0, 0, 0.05)})


def test_a_c_shaped_hole_is_refused_rather_than_fanned_through_the_fluid():
    """The rim of a half pipe goes along the wall and back: its lid would cut through the blood."""
    tube = geometry.tube(0.01, 0.05, 0.0015)
    angle = np.abs(np.arctan2(tube.centroids[:, 1], tube.centroids[:, 0]))
    band = (np.abs(tube.centroids[:, 2] - 0.025) < 0.008) & (angle < 2.6) & (tube.region == 0)
    assert 0.2 < band.mean() < 0.6
    with pytest.raises(SurfaceError, match="cannot be closed by a lid"):
        with_lids(Surface(tube.vertices, tube.faces[~band], tube.region[~band]))
