"""Surfaces: closedness, orientation, normals, volumes against closed forms, winding numbers."""

from __future__ import annotations

import numpy as np
import pytest

from geometry import (
    Grid,
    Surface,
    SurfaceError,
    SurfaceIndex,
    box,
    ellipse,
    ellipsoid,
    grid_winding,
    polygon,
    revolved,
    tube,
    winding_number,
)

SPHERE = ellipsoid((1.0, 1.0, 1.0), 0.2)


def _joined(*surfaces: Surface) -> Surface:
    start = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    faces = np.concatenate([s.faces + n for s, n in zip(surfaces, start, strict=False)])
    return Surface(np.concatenate([s.vertices for s in surfaces]), faces)


# what is made at a spacing, its volume (area in a plane) and, where there is a formula, its area
SHAPES = {
    "sphere": (lambda h: ellipsoid((1.0, 1.0, 1.0), h), 4 / 3 * np.pi, 4 * np.pi),
    "ellipsoid": (lambda h: ellipsoid((1.0, 2.0, 1.5), h, (5.0, 0.0, 0.0)), 4 * np.pi, None),
    "tube": (lambda h: tube(1.0, 3.0, h), 3 * np.pi, 8 * np.pi),
    "ellipse": (lambda h: ellipse((1.0, 2.0), h, (1.0, 1.0)), 2 * np.pi, None),
}


@pytest.mark.parametrize(("make", "volume", "area"), SHAPES.values(), ids=SHAPES.keys())
def test_volume_converges_with_the_square_of_the_spacing(make, volume: float, area: float | None) -> None:
    errors = []
    for spacing in (0.2, 0.1):
        surface = make(spacing)
        surface.check()
        errors.append(abs(surface.volume / volume - 1))
    assert errors[1] < 0.006 and 3.2 < errors[0] / errors[1] < 4.8
    if area is not None:
        assert surface.area == pytest.approx(area, rel=0.01)


def test_boxes_and_polygons_are_exact() -> None:
    brick = box((1, 2, 3), (2, 4, 6), 0.5)
    brick.check()
    assert brick.volume == pytest.approx(6, rel=1e-13) and brick.area == pytest.approx(22, rel=1e-13)
    square = polygon(np.array([[0, 0], [2, 0], [2, 1], [0, 1]]), 0.1)
    assert square.volume == pytest.approx(2, rel=1e-13) and square.area == pytest.approx(6, rel=1e-13)
    assert len(square.faces) == 60


def test_volume_does_not_depend_on_the_place() -> None:
    far = SPHERE.moved(SPHERE.vertices + np.array([1e4, -2e4, 3e4]))
    assert far.volume == pytest.approx(SPHERE.volume, rel=1e-9)


def test_a_moved_surface_is_judged_by_its_own_vertices() -> None:
    SPHERE.check()
    with pytest.raises(SurfaceError, match="inside out"):
        SPHERE.moved(SPHERE.vertices * np.array([1, 1, -1])).check()
    assert SPHERE.moved(2 * SPHERE.vertices).volume == pytest.approx(8 * SPHERE.volume, rel=1e-12)


def test_normals_point_outwards_and_area_vectors_close() -> None:
    assert (SPHERE.normals * SPHERE.centroids).sum(1).min() > 0.9
    assert (SPHERE.vertex_normals * SPHERE.vertices).sum(1).min() > 0.999
    np.testing.assert_allclose(SPHERE.area_vectors.sum(0), 0, atol=1e-13)
    square = polygon(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), 2.0)
    np.testing.assert_allclose(square.normals, [[0, -1], [1, 0], [0, 1], [-1, 0]], atol=1e-15)


def test_vertex_normals_do_not_depend_on_how_a_side_is_cut() -> None:
    # At the corner of a cube one or two triangles of a side may meet; the angles make all sides count alike.
    cube = box((0, 0, 0), (1, 1, 1), 1.0)
    expected = np.sign(cube.vertices - 0.5) / np.sqrt(3)
    np.testing.assert_allclose(cube.vertex_normals, expected, atol=1e-14)


def test_open_twisted_and_reversed_surfaces_are_told_apart() -> None:
    with pytest.raises(SurfaceError, match="not closed: 3 edges bound a hole"):
        Surface(SPHERE.vertices, SPHERE.faces[1:]).check()
    twisted = SPHERE.faces.copy()
    twisted[0] = twisted[0, ::-1]
    with pytest.raises(SurfaceError, match="beside 3 edges are numbered in opposite senses"):
        Surface(SPHERE.vertices, twisted).check()
    with pytest.raises(SurfaceError, match="inside out: it has normals"):
        Surface(SPHERE.vertices, SPHERE.faces[:, ::-1]).check()
    with pytest.raises(SurfaceError, match="not closed: 2 vertices"):
        Surface(np.array([[0, 0], [1, 0], [1, 1]]), [[0, 1], [1, 2]]).check()


def test_a_hole_inside_must_be_reversed_and_a_neighbour_must_not() -> None:
    inner = SPHERE.moved(0.5 * SPHERE.vertices)
    turned = Surface(inner.vertices, inner.faces[:, ::-1])
    shell = _joined(SPHERE, turned)
    shell.check()
    assert shell.volume == pytest.approx(SPHERE.volume * (1 - 1 / 8), rel=1e-12)
    with pytest.raises(SurfaceError, match="1 of its 2 pieces"):
        _joined(SPHERE, inner).check()
    beside = turned.moved(turned.vertices + 3.0)
    with pytest.raises(SurfaceError, match="1 of its 2 pieces"):
        _joined(SPHERE, beside).check()


def test_surfaces_that_touch_along_an_edge_are_closed() -> None:
    a = box((0, 0, 0), (1, 1, 1), 1.0)
    both = np.concatenate([a.vertices, a.vertices + [1, 1, 0]])
    vertices, place = np.unique(both, axis=0, return_inverse=True)
    touching = Surface(vertices, place.reshape(-1)[np.concatenate([a.faces, a.faces + len(a.vertices)])])
    assert len(vertices) == 14  # two corners are shared, and the edge between them bounds four faces
    touching.check()
    assert touching.volume == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((3, 4)), [[0, 1, 2]]), "vertices must be"),
        ((np.zeros((3, 3)), [[0, 1]]), "faces must be"),
        ((np.zeros((3, 3)), np.zeros((0, 3))), "at least one face"),
        ((np.full((3, 3), np.nan), [[0, 1, 2]]), "vertices must be finite"),
        ((np.zeros((3, 3)), [[0, 1, 3]]), "faces must number vertices 0 to 2"),
        ((np.zeros((3, 3)), [[0, 1, 2]], [0, 1]), "one label for each of the 1 faces"),
    ],
)
def test_malformed_surfaces_are_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(SurfaceError, match=message):
        Surface(*arguments)


def test_shapes_refuse_what_they_cannot_make() -> None:
    with pytest.raises(SurfaceError, match="ellipsoid: semi_axes must be 3 positive"):
        ellipsoid((1.0, -1.0, 1.0), 0.1)
    with pytest.raises(SurfaceError, match="start and end on the axis"):
        revolved(np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), 0.1)
    with pytest.raises(SurfaceError, match="inside out"):
        polygon(np.array([[0, 0], [0, 1], [1, 1]]), 1.0)


def test_trimesh_agrees() -> None:
    mesh = tube(1.0, 2.0, 0.3).trimesh()
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(tube(1.0, 2.0, 0.3).volume, rel=1e-12)
    assert np.bincount(mesh.face_attributes["region"]).tolist() == np.bincount(tube(1.0, 2.0, 0.3).region).tolist()


@pytest.mark.parametrize("surface", [SPHERE, ellipse((1.0, 0.6), 0.05), tube(0.6, 0.9, 0.2)], ids=["3d", "2d", "tube"])
def test_grid_winding_equals_the_sum_of_angles(surface: Surface) -> None:
    grid = Grid.covering((-1.1,) * surface.dimension, (1.1,) * surface.dimension, 0.2)
    nodes = grid.nodes().numpy()
    winding = grid_winding(grid, surface.vertices, surface.faces).ravel()
    clear = SurfaceIndex(surface).query(nodes).distance > 1e-6  # nodes on the surface may count either way
    angles = winding_number(surface.vertices, surface.faces, nodes[clear])
    assert clear.mean() > 0.9 and winding.max() == 1 and winding.min() == 0
    np.testing.assert_allclose(winding[clear], angles, atol=1e-9)


def test_grid_winding_counts_overlaps_and_meshes_that_sit_on_the_nodes() -> None:
    first, second = box((0, 0, 0), (1, 1, 1), 0.25), box((0.5, 0.5, 0.5), (2, 2, 2), 0.5)
    grid = Grid((0.125, 0.125, 0.125), (0.25, 0.25, 0.25), (8, 8, 8))
    both = _joined(first, second)
    winding = grid_winding(grid, both.vertices, both.faces)
    nodes = grid.nodes().numpy()
    expected = (nodes < 1).all(1).astype(int) + (nodes > 0.5).all(1)
    np.testing.assert_array_equal(winding.ravel(), expected)
    # Grid lines through the edges and vertices of the mesh must still be counted once.
    aligned = Grid((-0.25, -0.25, 0.125), (0.25, 0.25, 0.25), (4, 8, 8))
    inside = grid_winding(aligned, first.vertices, first.faces)
    lateral = aligned.nodes().numpy()[:, :2]
    strictly = ((lateral > 0) & (lateral < 1)).all(1)
    outside = ((lateral < 0) | (lateral > 1)).any(1)
    assert (inside.ravel()[strictly] == 1).all() and (inside.ravel()[outside] == 0).all()
