"""Mending, refining and reading surfaces: what comes out must enclose what was meant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geometry import (
    Surface,
    SurfaceError,
    Ventricle,
    WallMotion,
    box,
    ellipse,
    ellipsoid,
    labelled,
    polygon,
    read_surface,
    refined,
    refined_motion,
    repaired,
    tube,
    write_surface,
)

SHAPE = Ventricle().surface(1.5e-3)


def _soup(surface: Surface) -> Surface:
    """Every face with vertices of its own, as in a STL file."""
    corners = surface.vertices[surface.faces].reshape(-1, surface.dimension)
    return Surface(corners, np.arange(len(corners)).reshape(surface.faces.shape), surface.region)


def test_a_sound_surface_comes_back_unchanged() -> None:
    for surface in (SHAPE, ellipse((1.0, 2.0), 0.2)):
        result = repaired(surface)
        np.testing.assert_array_equal(result.faces, surface.faces)
        np.testing.assert_array_equal(result.region, surface.region)


def test_seams_turned_faces_duplicates_and_slivers_are_mended() -> None:
    draw = np.random.default_rng(0)
    soup = _soup(SHAPE)
    vertices = soup.vertices + draw.uniform(-1e-10, 1e-10, soup.vertices.shape)
    faces = soup.faces.copy()
    turned = draw.random(len(faces)) < 0.4
    faces[turned] = faces[turned][:, ::-1]
    faces = np.concatenate([faces, faces[:5], faces[:3, [0, 0, 1]]])
    region = np.concatenate([soup.region, soup.region[:5], [0, 0, 0]])
    result = repaired(Surface(vertices, faces, region))
    assert result.volume == pytest.approx(SHAPE.volume, rel=1e-6)
    assert len(result.vertices) == len(SHAPE.vertices) and len(result.faces) == len(SHAPE.faces)
    np.testing.assert_array_equal(np.sort(result.region), np.sort(SHAPE.region))


def test_holes_are_closed_and_labelled() -> None:
    pipe = tube(1.0, 3.0, 0.1)
    open_pipe = Surface(pipe.vertices, pipe.faces[pipe.region == 0])
    result = repaired(open_pipe, hole_region=7)
    result.check()
    assert result.volume == pytest.approx(pipe.volume, rel=1e-9)
    assert result.areas[result.region == 7].sum() == pytest.approx(2 * np.pi, rel=0.01)
    one_missing = repaired(Surface(SHAPE.vertices, np.delete(SHAPE.faces, 17, axis=0)))
    assert one_missing.volume == pytest.approx(SHAPE.volume, rel=1e-12)


def test_pieces_inside_out_are_turned_by_how_they_nest() -> None:
    ball = ellipsoid((1.0, 1.0, 1.0), 0.4)
    inner = ball.vertices * 0.4
    faces = np.concatenate([ball.faces[:, ::-1], ball.faces + len(inner)])
    result = repaired(Surface(np.concatenate([ball.vertices, inner]), faces))
    assert result.volume == pytest.approx(ball.volume * (1 - 0.4**3), rel=1e-9)


def test_outlines_are_closed_and_turned() -> None:
    ring = ellipse((1.0, 1.0), 0.1)
    broken = Surface(ring.vertices, ring.faces[1:, ::-1])
    assert repaired(broken).volume == pytest.approx(ring.volume, rel=1e-12)
    with pytest.raises(SurfaceError, match="several gaps"):
        repaired(Surface(ring.vertices, np.delete(ring.faces, [3, 30], axis=0)))


def test_what_cannot_be_mended_is_said() -> None:
    cube = box((0, 0, 0), (1, 1, 1), 1.0)
    edge = cube.faces[0, :2]
    vertices = np.concatenate([cube.vertices, [[3.0, 3.0, 3.0]]])
    fin = Surface(vertices, np.concatenate([cube.faces, [[edge[0], edge[1], len(cube.vertices)]]]))
    with pytest.raises(SurfaceError, match="cannot be mended"):
        repaired(fin)
    with pytest.raises(SurfaceError, match="none of its faces has an extent"):
        repaired(Surface(np.zeros((3, 3)), [[0, 0, 1]]))
    with pytest.raises(SurfaceError, match="merge must be a length"):
        repaired(SHAPE, merge=-1.0)


@pytest.mark.parametrize("surface", [box((0, 0, 0), (1, 2, 3), 5.0), SHAPE], ids=["box", "ventricle"])
def test_refining_bounds_the_edges_and_changes_nothing_else(surface: Surface) -> None:
    spacing = 0.3 * float(np.sqrt(surface.areas.mean()))
    result = refined(surface, spacing)
    result.check()
    ends = result.vertices[result.faces]
    assert np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).max() <= spacing
    assert result.volume == pytest.approx(surface.volume, rel=1e-12)
    for label in np.unique(surface.region):
        area = surface.areas[surface.part(label)].sum()
        assert result.areas[result.part(label)].sum() == pytest.approx(area, rel=1e-12)
    assert refined(surface, 1e9).faces is not result.faces and len(refined(surface, 1e9).faces) == len(surface.faces)


def test_refined_triangles_keep_their_shape() -> None:
    """The smallest angle must not fall with every round, or flat walls would be covered in slivers."""
    angles = []
    for spacing in (0.3, 0.02):
        ends = refined(box((0, 0, 0), (1, 1, 0.3), 2.0), spacing)
        corner = ends.vertices[ends.faces]
        sides = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2)
        angles.append(np.degrees((2 * ends.areas / (sides.max(axis=1) ** 2)).min()))
    assert angles[1] > 0.4 * angles[0]


def test_outlines_are_refined_too() -> None:
    result = refined(polygon(np.array([[0, 0], [1, 0], [0, 1]]), 5.0), 0.1)
    result.check()
    assert result.areas.max() <= 0.1 and result.volume == pytest.approx(0.5)


def test_a_refined_motion_has_the_same_volume_and_rate() -> None:
    motion = WallMotion.from_recording(Ventricle().recording(np.linspace(0, 0.1, 5), wall_spacing=2e-3))
    fine = refined_motion(motion, 1e-3)
    assert fine.vertices_at_keys.shape[1] > 2 * motion.vertices_at_keys.shape[1]
    for t in (0.0, 0.06):
        assert fine.volume(t) == pytest.approx(motion.volume(t), rel=1e-12)
        assert fine.volume_rate(t) == pytest.approx(motion.volume_rate(t), rel=1e-9, abs=1e-18)


def test_refining_refuses_nonsense() -> None:
    for spacing in (0.0, -1.0):
        with pytest.raises(SurfaceError, match="spacing must be a positive length"):
            refined(SHAPE, spacing)
    with pytest.raises(SurfaceError, match="is it in m"):
        refined(polygon(np.array([[0, 0], [1, 0], [0, 1]]), 5.0), 1e-12)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_files_round_trip_in_millimetres(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"ventricle.{suffix}"
    write_surface(path, SHAPE, scale=1e-3)
    back = read_surface(path, scale=1e-3)
    back.check()
    assert back.volume == pytest.approx(SHAPE.volume, rel=1e-6)
    assert len(back.vertices) == len(SHAPE.vertices)
    if suffix == "ply":
        np.testing.assert_array_equal(back.region, SHAPE.region)
    with pytest.raises(SurfaceError, match=rf"ventricle.{suffix}: is .* large, so it is probably in mm"):
        read_surface(path)


def test_open_files_are_closed_or_reported(tmp_path: Path) -> None:
    path = tmp_path / "open.stl"
    write_surface(path, Surface(SHAPE.vertices, SHAPE.faces[5:]))
    assert read_surface(path).volume == pytest.approx(SHAPE.volume, rel=1e-3)
    with pytest.raises(SurfaceError, match="not closed"):
        read_surface(path, mend=False).check()


def test_files_that_hold_no_surface_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere.stl"):
        read_surface(tmp_path / "nowhere.stl")
    (tmp_path / "mesh.msh").write_text("x")
    with pytest.raises(SurfaceError, match="mesh.msh: surfaces are read from .stl, .obj, .ply, .vtp, .vtk, not"):
        read_surface(tmp_path / "mesh.msh")
    for name in ("bad.ply", "bad.stl", "bad.obj"):
        (tmp_path / name).write_text("nothing of the kind")
        with pytest.raises(SurfaceError, match=name):
            read_surface(tmp_path / name)
    with pytest.raises(SurfaceError, match="scale must be positive"):
        read_surface(tmp_path / "bad.ply", scale=0)
    with pytest.raises(SurfaceError, match="written to"):
        write_surface(tmp_path / "mesh.vtk", SHAPE)


def test_regions_are_labelled_by_place_and_direction() -> None:
    plain = Surface(SHAPE.vertices, SHAPE.faces)
    shape = Ventricle()
    centre = (*shape.aortic_centre, 0.0)
    result = labelled(plain, 2, centre=centre, radius=shape.aortic_radius, normal=(0, 0, 1))
    np.testing.assert_array_equal(result.region == 2, SHAPE.region == 2)
    with pytest.raises(SurfaceError, match="no face lies within"):
        labelled(plain, 2, centre=(1.0, 1.0, 1.0), radius=0.01)
