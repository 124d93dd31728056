"""Walls of finite thickness: their inner sheet is found, or they are refused; bodies of blood are left alone."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from geometry import Surface, SurfaceError, Ventricle, ellipsoid, read_surface, repaired, tube, write_surface
from geometry.formats import FieldMap, WallOptions, convert
from geometry.surfaces.shells import inner_sheet, shell_of
from torchsph.cli import main as torchsph

AROUND = 48


def revolved(profile: list[tuple[float, float]]) -> Surface:
    """The closed surface of a closed profile of (radius, height) that goes around the axis."""
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    vertices = [(r * np.cos(one), r * np.sin(one), height) for r, height in profile for one in angle]
    faces = []
    for row in range(len(profile)):
        for k in range(AROUND):
            here, ahead = AROUND * row, AROUND * ((row + 1) % len(profile))
            a, b, c, d = here + k, here + (k + 1) % AROUND, ahead + k, ahead + (k + 1) % AROUND
            faces += [(a, b, d), (a, d, c)]
    return repaired(Surface(np.array(vertices), np.array(faces)))


def pipe(inner: float, outer: float, length: float) -> Surface:
    heights = np.linspace(0, length, 20)
    return revolved([(outer, z) for z in heights] + [(inner, z) for z in heights[::-1]])


def cup(radius: float, depth: float, thickness: float, cut: float) -> Surface:
    """A myocardium: between two half ellipsoids, from the apex to a cut above the equator; a pinhole at the apex."""
    angle = np.linspace(1e-3, math.acos(-cut), 24)
    inner = [(radius * math.sin(one), -depth * math.cos(one)) for one in angle]
    outer = [((radius + thickness) * math.sin(one), -(depth + thickness) * math.cos(one)) for one in angle]
    return revolved(inner + outer[::-1])


def cup_volume(radius: float, depth: float, cut: float) -> float:
    return math.pi * radius**2 * depth * (cut - cut**3 / 3 + 2 / 3)


def nested(outer: Surface, inner: Surface) -> Surface:
    both = np.concatenate([outer.faces, inner.faces + len(outer.vertices)])
    return Surface(np.concatenate([outer.vertices, inner.vertices]), both)


WALL, CAVITY = ellipsoid((0.030, 0.030, 0.045), 0.005), ellipsoid((0.022, 0.022, 0.036), 0.005)
SHELLS = {
    "vessel": (pipe(0.008, 0.011, 0.06), math.pi * 0.008**2 * 0.06),
    "thin vessel": (pipe(0.012, 0.013, 0.08), math.pi * 0.012**2 * 0.08),
    "myocardium in diastole": (cup(0.022, 0.04, 0.009, 0.3), cup_volume(0.022, 0.04, 0.3)),
    "myocardium in systole": (cup(0.013, 0.03, 0.014, 0.3), cup_volume(0.013, 0.03, 0.3)),
    "myocardium cut at the equator": (cup(0.022, 0.04, 0.009, 0.0), cup_volume(0.022, 0.04, 0.0)),
    "two closed sheets": (nested(WALL, CAVITY), CAVITY.volume),
}


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj"])
@pytest.mark.parametrize("name", SHELLS)
def test_a_thick_wall_is_refused_or_its_inner_sheet_taken(tmp_path: Path, name: str, suffix: str) -> None:
    surface, lumen = SHELLS[name]
    path = tmp_path / f"thick{suffix}"
    write_surface(path, surface, scale=1e-3)
    with pytest.raises(SurfaceError, match=rf"thick{suffix}: is a wall of finite thickness: .* ml .*--sheet inner"):
        read_surface(path, scale=1e-3)
    found = read_surface(path, scale=1e-3, sheet="inner", hole_region=(1, 2))
    assert found.volume == pytest.approx(lumen, rel=6e-3)  # 48 sides of a circle enclose .3 % less
    assert read_surface(path, scale=1e-3, sheet="all").volume == pytest.approx(repaired(surface).volume, rel=1e-5)


def test_the_openings_of_an_inner_sheet_are_labelled() -> None:
    surface, _ = SHELLS["vessel"]
    found = inner_sheet(surface, hole_region=(1, 2))
    for region in (1, 2):
        cap = found.centroids[found.region == region]
        assert np.ptp(cap[:, 2]) < 1e-9 and np.hypot(*cap[:, :2].T).max() < 0.008
    assert abs(found.part(1).size - found.part(2).size) == 0


def curved(turn: float) -> Surface:
    """Blood in a bent vessel of 12 mm radius."""
    along, around = np.linspace(0, turn, 40), 2 * np.pi * np.arange(20) / 20
    vertices, faces = [], []
    for a in along:
        for b in around:
            r = 0.02 + 0.012 * np.cos(b)
            vertices.append((r * np.cos(a), r * np.sin(a), 0.012 * np.sin(b)))
    for row in range(39):
        for k in range(20):
            a, b = 20 * row + k, 20 * row + (k + 1) % 20
            faces += [(a, a + 20, b), (b, a + 20, b + 20)]
    return repaired(Surface(np.array(vertices), np.array(faces)))


BLOOD = {
    "ellipsoid": WALL,
    "pipe": tube(0.01, 0.06, 0.004),
    "an arch": curved(np.pi),
    "nearly a ring": curved(5.8),
    "a ventricle": Ventricle().surface(4e-3),
    "a papillary muscle in it": repaired(nested(WALL, ellipsoid((0.004, 0.004, 0.012), 0.003))),
    "two beside each other": repaired(nested(WALL, Surface(WALL.vertices + [0.07, 0, 0], WALL.faces))),
}


@pytest.mark.parametrize("name", BLOOD)
def test_bodies_of_blood_are_no_walls(tmp_path: Path, name: str) -> None:
    assert shell_of(BLOOD[name]) is None
    write_surface(tmp_path / "blood.ply", BLOOD[name])
    assert read_surface(tmp_path / "blood.ply").volume == pytest.approx(BLOOD[name].volume, rel=1e-5)
    with pytest.raises(SurfaceError, match="has no inner sheet: it surrounds no lumen"):
        read_surface(tmp_path / "blood.ply", sheet="inner")


def test_what_cannot_be_told_apart_is_refused() -> None:
    with pytest.raises(SurfaceError, match="cannot be told from its rim"):
        inner_sheet(pipe(0.010, 0.012, 0.025))


def test_a_series_of_thick_walls_keeps_its_inner_sheet(tmp_path: Path) -> None:
    surface, lumen = SHELLS["vessel"]
    for number, scale in enumerate((1.0, 1.1, 1.05)):
        moved = Surface(surface.vertices * [scale, scale, 1], surface.faces)
        write_surface(tmp_path / f"wall_{number}.obj", moved, scale=1e-3)
    said = FieldMap(length_unit="mm", grid_spacing=0.004, period=0.8)
    wall = WallOptions(openings=2, sheet="inner")
    found = convert(sorted(tmp_path.glob("*.obj")), said, wall=wall).recording
    volumes = [found.wall.at(frame).volume for frame in range(3)]
    np.testing.assert_allclose(volumes, lumen * np.array([1, 1.1, 1.05]) ** 2, rtol=4e-3)


def test_the_command_line_says_how(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_surface(tmp_path / "thick.stl", SHELLS["vessel"][0], scale=1e-3)
    line = f"convert {tmp_path}/thick.stl --length-unit mm --grid-spacing 0.004 --out {tmp_path}/m.h5"
    assert torchsph(line.split()) == 2
    assert "thick.stl: is a wall of finite thickness" in capsys.readouterr().err
    assert not (tmp_path / "m.h5").exists()
    assert torchsph([*line.split(), "--sheet", "inner", "--openings", "2"]) in (0, None)
    assert torchsph([*line.split(), "--sheet", "all"]) in (0, None)
    capsys.readouterr()
    assert torchsph(["info", f"{tmp_path}/m.h5"]) in (0, None)
    said = capsys.readouterr()
    assert "/wall/faces: is a wall of finite thickness" in said.out + said.err
    assert torchsph([*line.split(), "--sheet", "all", "--strict"]) == 2
