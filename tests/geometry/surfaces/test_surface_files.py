"""Files of surfaces as other programs write them: the body that the file describes, or an error."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from geometry import Surface, SurfaceError, box, read_surface, write_surface
from geometry.formats import FieldMap, convert

BOX = box((0, 0, 0), (0.02, 0.02, 0.02), 0.01)
VOLUME = 8e-6
QUADS = [(0, 2, 3, 1), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6), (4, 5, 7, 6)]
CORNERS = 0.02 * np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)])


def _vertices(points: np.ndarray) -> list[str]:
    return ["v {:.9g} {:.9g} {:.9g}".format(*point) for point in points]


def _relative(faces: np.ndarray, count: int) -> list[str]:
    return ["f {} {} {}".format(*(face - count)) for face in faces]


def _read_text(path: Path, lines: list[str], **options: bool) -> Surface:
    path.write_text("\n".join(lines) + "\n")
    return read_surface(path, **options)


def test_obj_counts_negative_indices_from_the_line_they_stand_in(tmp_path: Path) -> None:
    blocks = [line for face in BOX.faces for line in [*_vertices(BOX.vertices[face]), "f -3/1 -2//2 -1"]]
    classic = _vertices(BOX.vertices) + _relative(BOX.faces, len(BOX.vertices))
    for name, lines in (("blocks", blocks), ("classic", classic)):
        surface = _read_text(tmp_path / f"{name}.obj", lines)
        surface.check()
        assert surface.volume == pytest.approx(VOLUME, rel=1e-9)
        assert len(surface.faces) == len(BOX.faces)


def test_obj_bodies_in_blocks_are_all_kept(tmp_path: Path) -> None:
    lines = []
    for shift in (0.0, 0.03):
        lines += _vertices(BOX.vertices + [shift, 0, 0]) + _relative(BOX.faces, len(BOX.vertices))
    for mend in (True, False):
        surface = _read_text(tmp_path / "two.obj", lines, mend=mend)
        assert surface.component_volumes == pytest.approx([VOLUME, VOLUME])


def test_obj_quads_comments_and_continued_lines(tmp_path: Path) -> None:
    lines = [*_vertices(CORNERS), "# a comment", "vt 0 0", "s off"]
    lines += ["f {} {} \\\n {} {}  # side".format(*(np.array(quad) + 1)) for quad in QUADS]
    assert _read_text(tmp_path / "quads.obj", lines).volume == pytest.approx(VOLUME)


@pytest.mark.parametrize(
    ("line", "message"),
    [("f 1 2 99", "vertex number 98"), ("f 1 2 -99", "line 9"), ("f 0 1 2", "counted from 1"), ("f 1 2", "fewer")],
)
def test_obj_faces_of_vertices_that_are_not_there_are_refused(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(SurfaceError, match=message):
        _read_text(tmp_path / "bad.obj", [*_vertices(CORNERS), line])


def _ply_header(form: str, vertices: int, faces: int, label: str = "region") -> str:
    return (
        f"ply\nformat {form} 1.0\ncomment made by hand\nelement vertex {vertices}\nproperty float x\n"
        "property float y\nproperty float z\nproperty uchar red\n"
        f"element face {faces}\nproperty uchar {label}\nproperty list uchar int vertex_indices\n"
        "property float quality\nend_header\n"
    )


MIXED = [(number, quad) for number, quad in enumerate(QUADS[1:])] + [(7, (0, 2, 3)), (9, (0, 3, 1))]


def _ascii(polygons: list) -> bytes:
    points = ["{:g} {:g} {:g} 200".format(*point) for point in CORNERS]
    faces = [f"{label} {len(face)} {' '.join(map(str, face))} .5" for label, face in polygons]
    return (_ply_header("ascii", len(points), len(faces)) + "\n".join(points + faces) + "\n").encode()


def _binary(polygons: list, order: str) -> bytes:
    name = "binary_little_endian" if order == "<" else "binary_big_endian"
    body = b"".join(struct.pack(order + "3fB", *point, 200) for point in CORNERS)
    for label, face in polygons:
        body += struct.pack(f"{order}BB{len(face)}if", label, len(face), *face, 0.5)
    return _ply_header(name, len(CORNERS), len(polygons)).encode() + body


@pytest.mark.parametrize("form", ["ascii", "little", "big"])
@pytest.mark.parametrize("polygons", [MIXED, list(enumerate(QUADS))], ids=["mixed", "quads"])
def test_ply_polygons_keep_their_labels(tmp_path: Path, form: str, polygons: list) -> None:
    data = _ascii(polygons) if form == "ascii" else _binary(polygons, "<" if form == "little" else ">")
    (tmp_path / "box.ply").write_bytes(data)
    surface = read_surface(tmp_path / "box.ply")
    assert surface.volume == pytest.approx(VOLUME, rel=1e-6)
    area = {label: 0.02**2 * (1 if len(face) == 4 else 0.5) for label, face in polygons}
    for label, expected in area.items():
        assert surface.areas[surface.region == label].sum() == pytest.approx(expected, rel=1e-6)


def test_ply_of_trimesh_in_both_encodings(tmp_path: Path) -> None:
    for encoding in ("ascii", "binary"):
        path = tmp_path / f"{encoding}.ply"
        BOX.trimesh().export(path, encoding=encoding)
        assert read_surface(path).volume == pytest.approx(VOLUME, rel=1e-6)


@pytest.mark.parametrize("keep", [40, -60, -5])
def test_ply_that_ends_too_early_is_refused(tmp_path: Path, keep: int) -> None:
    for data in (_ascii(MIXED), _binary(MIXED, "<")):
        (tmp_path / "cut.ply").write_bytes(data[:keep])
        with pytest.raises(SurfaceError, match=r"cut.ply: (is no PLY|ends within|holds)"):
            read_surface(tmp_path / "cut.ply")


def test_a_concave_quad_is_cut_along_its_inner_diagonal(tmp_path: Path) -> None:
    """A dart: across it, the triangles would cover more than the polygon."""
    base = np.array([[0, 0], [0.02, 0], [0.005, 0.005], [0, 0.02]])
    for turn in range(4):
        dart = np.roll(base, turn, axis=0)
        prism = np.concatenate([np.c_[dart, np.zeros(4)], np.c_[dart, np.full(4, 0.01)]])
        sides = [(i, (i + 1) % 4, 4 + (i + 1) % 4, 4 + i) for i in range(4)]
        lines = _vertices(prism)
        lines += ["f {} {} {} {}".format(*(np.array(quad) + 1)) for quad in [(3, 2, 1, 0), (4, 5, 6, 7), *sides]]
        surface = _read_text(tmp_path / "dart.obj", lines)
        assert surface.volume == pytest.approx(1e-6, rel=1e-9)  # area 2 * 1/2 * .02 * .005 m^2, height 1 cm
        assert np.abs(surface.areas.sum() - (2 * 1e-4 + 0.01 * (0.04 + 2 * np.hypot(0.015, 0.005)))) < 1e-9


def test_vtp_files_with_quads_and_cell_labels(tmp_path: Path) -> None:
    pytest.importorskip("vtk", reason="the extra `formats` is not installed")
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    points, cells, mesh = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(CORNERS, deep=True))
    for quad in QUADS:
        cells.InsertNextCell(4, quad)
    labels = numpy_to_vtk(np.arange(6, dtype=np.int32), deep=True)
    labels.SetName("RegionId")
    mesh.SetPoints(points)
    mesh.SetPolys(cells)
    mesh.GetCellData().AddArray(labels)
    for mode in ("SetDataModeToAscii", "SetDataModeToAppended"):
        writer = vtkXMLPolyDataWriter()
        writer.SetFileName(str(tmp_path / "box.vtp"))
        writer.SetInputData(mesh)
        getattr(writer, mode)()
        writer.Write()
        surface = read_surface(tmp_path / "box.vtp")
        assert surface.volume == pytest.approx(VOLUME, rel=1e-6)
        assert [surface.areas[surface.region == n].sum() for n in range(6)] == pytest.approx([4e-4] * 6)
    (tmp_path / "bad.vtp").write_text("nothing of the kind")
    with pytest.raises(SurfaceError, match="bad.vtp"):
        read_surface(tmp_path / "bad.vtp")


def test_longest_holes_are_labelled_in_order(tmp_path: Path) -> None:
    from geometry import tube

    pipe = tube(0.01, 0.06, 0.002)
    side = pipe.faces[pipe.region == 0]
    cone = pipe.vertices * (1 - 5 * pipe.vertices[:, 2:] * [1, 1, 0])
    write_surface(tmp_path / "open.ply", Surface(cone, np.delete(side, [100, 300], axis=0)))
    surface = read_surface(tmp_path / "open.ply", hole_region=(1, 2))
    wide, narrow = (surface.centroids[surface.region == label][:, 2] for label in (1, 2))
    assert np.abs(wide).max() < 1e-6 and np.abs(narrow - 0.06).max() < 1e-6
    assert set(np.unique(surface.region)) == {0, 1, 2}


@pytest.mark.parametrize(
    "corner",
    ["{0}", "{0}/1", "{0}//1", "{0}/1/1", "{1}", "{1}//-1", "{1}/-1/-1"],
    ids=["v", "v/t", "v//n", "v/t/n", "-v", "-v//-n", "-v/-t/-n"],
)
@pytest.mark.parametrize(
    "heads", [[], ["o body", "g side top", "usemtl red"], ["g"]], ids=["plain", "named", "unnamed"]
)
def test_obj_corners_in_every_form(tmp_path: Path, corner: str, heads: list[str]) -> None:
    lines = ["mtllib box.mtl", *_vertices(CORNERS), "vt 0 0", "vn 0 0 1", *heads]
    for number, quad in enumerate(QUADS):
        lines += ["s 1"] * (number == 2) + ["f " + " ".join(corner.format(k + 1, k - len(CORNERS)) for k in quad)]
    assert _read_text(tmp_path / "box.obj", lines).volume == pytest.approx(VOLUME)


def test_obj_polygons_of_many_corners_lines_and_weights(tmp_path: Path) -> None:
    """A prism on a hexagon, with lines and points beside its faces, and a fourth number in each vertex."""
    angle = np.pi / 3 * np.arange(6)
    ring = 0.01 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate([np.c_[ring, np.zeros(6)], np.c_[ring, np.full(6, 0.02)]])
    lines = [f"{line} 1.0" for line in _vertices(points)]
    lines += ["l 1 2 3", "p 4", "f 6 5 4 3 2 1", "f 7 8 9 10 11 12"]
    lines += [f"f {k + 1} {(k + 1) % 6 + 1} {(k + 1) % 6 + 7} {k + 7}" for k in range(6)]
    assert _read_text(tmp_path / "hexagon.obj", lines).volume == pytest.approx(1.5 * np.sqrt(3) * 1e-4 * 0.02, rel=1e-9)


def _ply(form: str, counts: str, numbers: str, lists: str) -> bytes:
    """A box of quads whose properties have other names and types, with edges between vertices and faces."""
    order = ">" if form == "binary_big_endian" else "<"
    codes = {"uchar": "B", "uint8": "B", "ushort": "H", "uint": "I", "int": "i", "int32": "i", "short": "h"}
    reals = {"float": "f", "float64": "d", "double": "d"}
    head = f"ply\nformat {form} 1.0\nobj_info no name\nelement vertex {len(CORNERS)}\n"
    head += "".join(f"property {numbers} {axis}\n" for axis in ("x", "y", "z"))
    head += "element edge 2\nproperty int vertex1\nproperty int vertex2\n"
    head += (
        f"element face {len(QUADS)}\nproperty list {counts} {lists} {'vertex_index'}\nproperty int label\nend_header\n"
    )
    if form == "ascii":
        rows = ["{:.9g} {:.9g} {:.9g}".format(*point) for point in CORNERS] + ["0 1", "1 2"]
        rows += [f"4 {' '.join(map(str, quad))} {number}" for number, quad in enumerate(QUADS)]
        return (head + "\r\n".join(rows) + "\r\n").encode()
    body = b"".join(struct.pack(f"{order}3{reals[numbers]}", *point) for point in CORNERS)
    body += struct.pack(f"{order}4i", 0, 1, 1, 2)
    for number, quad in enumerate(QUADS):
        body += struct.pack(f"{order}{codes[counts]}4{codes[lists]}i", 4, *quad, number)
    return head.encode() + body


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    ("counts", "numbers", "lists"),
    [
        ("uchar", "float", "uint"),
        ("uint8", "double", "int32"),
        ("ushort", "float64", "short"),
        ("int", "float", "uchar"),
    ],
)
def test_ply_of_every_type_of_list(tmp_path: Path, form: str, counts: str, numbers: str, lists: str) -> None:
    (tmp_path / "box.ply").write_bytes(_ply(form, counts, numbers, lists))
    surface = read_surface(tmp_path / "box.ply")
    assert surface.volume == pytest.approx(VOLUME, rel=1e-6)
    assert [surface.areas[surface.region == n].sum() for n in range(6)] == pytest.approx([4e-4] * 6)


@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_stl_in_millimetres(tmp_path: Path, form: str) -> None:
    mesh = BOX.trimesh()
    mesh.vertices = 1e3 * mesh.vertices
    mesh.export(tmp_path / "box.stl", file_type="stl" if form == "binary" else "stl_ascii")
    assert read_surface(tmp_path / "box.stl", scale=1e-3).volume == pytest.approx(VOLUME, rel=1e-6)
    with pytest.raises(SurfaceError, match=r"is 20 m large, so it is probably in mm"):
        read_surface(tmp_path / "box.stl")


@pytest.mark.parametrize("mode", ["Ascii", "Binary", "Appended"])
@pytest.mark.parametrize("packed", [None, "ZLib", "LZ4"])
def test_vtp_in_every_encoding(tmp_path: Path, mode: str, packed: str | None) -> None:
    pytest.importorskip("vtkmodules", reason="the extra `formats` is not installed")
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    points, strips, mesh = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(CORNERS, deep=True))
    for a, b, c, d in QUADS:  # each side as a strip of two triangles
        strips.InsertNextCell(4, (a, b, d, c))
    mesh.SetPoints(points)
    mesh.SetStrips(strips)
    writer = vtkXMLPolyDataWriter()
    writer.SetFileName(str(tmp_path / "box.vtp"))
    writer.SetInputData(mesh)
    getattr(writer, f"SetDataModeTo{mode}")()
    getattr(writer, f"SetCompressorTypeTo{packed}")()
    writer.Write()
    assert read_surface(tmp_path / "box.vtp").volume == pytest.approx(VOLUME, rel=1e-6)
    legacy = vtkPolyDataWriter()
    legacy.SetFileName(str(tmp_path / "box.vtk"))
    legacy.SetInputData(mesh)
    (legacy.SetFileTypeToASCII if mode == "Ascii" else legacy.SetFileTypeToBinary)()
    legacy.Write()
    assert read_surface(tmp_path / "box.vtk").volume == pytest.approx(VOLUME, rel=1e-6)
    found = convert([tmp_path / "box.vtk"], FieldMap(grid_spacing=0.005)).recording
    assert found.wall.at(0).volume == pytest.approx(VOLUME, rel=1e-6)
