"""Bodies that overlap are refused by name or united; those that touch or nest are neither."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geometry import Surface, SurfaceError, box, ellipsoid, read_surface, write_surface
from geometry.surfaces.overlap import overlapping_pieces, refuse_overlaps, united

BALL = ellipsoid((0.012,) * 3, 0.002)


def _together(*bodies: Surface) -> Surface:
    shift = np.cumsum([0] + [len(body.vertices) for body in bodies[:-1]])
    faces = [body.faces + start for body, start in zip(bodies, shift, strict=True)]
    region = np.concatenate([body.region for body in bodies])
    return Surface(np.concatenate([body.vertices for body in bodies]), np.concatenate(faces), region)


def _moved(body: Surface, *shift: float) -> Surface:
    return body.moved(body.vertices + np.array(shift))


CROSSED = _together(BALL, _moved(BALL, 0.012, 0.0003, 0.0002))
BARS = _together(box((-0.03, -0.004, -0.004), (0.03, 0.004, 0.004), 1.0), box((-0.003, -0.03, -0.003), (0.003,) * 3, 1))


@pytest.mark.parametrize("surface", [CROSSED, BARS], ids=["balls", "bars whose corners are all outside"])
def test_crossing_bodies_are_found(surface: Surface) -> None:
    assert overlapping_pieces(surface) == [(0, 1)]
    with pytest.raises(SurfaceError, match=r"'left' around .* mm and body 2 around .* mm"):
        refuse_overlaps(surface, ["left", ""])


@pytest.mark.parametrize(
    "surface",
    [
        BALL,
        _together(BALL, _moved(BALL, 0.03, 0, 0)),
        _together(box((0, 0, 0), (0.02,) * 3, 0.01), box((0.02, 0, 0), (0.04, 0.02, 0.02), 0.01)),
        _together(box((0, 0, 0), (0.02,) * 3, 0.01), box((0.02, 0.005, 0.005), (0.04, 0.015, 0.015), 0.01)),
        _together(BALL, Surface(0.4 * BALL.vertices, BALL.faces[:, ::-1])),
    ],
    ids=["one", "apart", "touching along a side", "touching within a side", "cavity"],
)
def test_bodies_that_do_not_cross_are_left_alone(surface: Surface) -> None:
    assert overlapping_pieces(surface) == []
    refuse_overlaps(surface)
    assert united(surface) is surface


def test_files_name_the_bodies_that_overlap(tmp_path: Path) -> None:
    write_surface(tmp_path / "two.stl", CROSSED)
    with pytest.raises(SurfaceError, match=r"two.stl: its bodies overlap: body 1 around"):
        read_surface(tmp_path / "two.stl")
    lines = []
    for name, start in (("atrium", 0), ("appendage", len(BALL.vertices))):
        part = CROSSED.faces[: len(BALL.faces)] + start
        points = CROSSED.vertices[start : start + len(BALL.vertices)]
        lines += [f"o {name}", *("v {} {} {}".format(*point) for point in points.tolist())]
        lines += ["f {} {} {}".format(*(face + 1)) for face in part]
    (tmp_path / "two.obj").write_text("\n".join(lines))
    with pytest.raises(SurfaceError, match="'atrium' around .* and 'appendage' around"):
        read_surface(tmp_path / "two.obj")


def test_the_union_has_the_volume_of_two_balls_less_their_lens(tmp_path: Path) -> None:
    pytest.importorskip("manifold3d", reason="the extra `formats` is not installed")
    fine = ellipsoid((0.012,) * 3, 0.0008)
    other = _moved(fine, 0.012, 0, 0)
    labelled = Surface(other.vertices, other.faces, np.full(len(other.faces), 5, np.uint8))
    write_surface(tmp_path / "two.ply", _together(fine, labelled))
    surface = read_surface(tmp_path / "two.ply", unite=True)
    surface.check()
    assert len(surface.component_volumes) == 1
    lens = np.pi * (4 * 0.012 + 0.012) * (2 * 0.012 - 0.012) ** 2 / 12  # of two equal balls d = 12 mm apart
    assert surface.volume == pytest.approx(2 * 4 / 3 * np.pi * 0.012**3 - lens, rel=0.01)
    assert (surface.region[surface.centroids[:, 0] > 0.0065] == 5).all()
    assert (surface.region[surface.centroids[:, 0] < 0.0055] == 0).all()
