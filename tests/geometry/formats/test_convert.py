"""Files as labs have them, written by the formats' own libraries: places, components, units and times."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from geometry import Surface, SurfaceError, ellipsoid, findings, tube, write_surface
from geometry.formats import FieldMap, FormatError, WallOptions, convert, read_field_map

EXTRA = "the extra `formats` is not installed"
COUNTS = (9, 8, 7)  # of nodes along i, j, k
STEP = np.array([2.0, 2.5, 3.0])  # mm


def flow(points: np.ndarray) -> np.ndarray:
    """A flow without divergence, m/s at m, along the coordinates' axes."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([20 * x - 9 * y + 0.1, 10 * x + 10 * y, -30 * z + 5 * x], axis=-1)


def placed(matrix: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An affine, mm, and the flow (i, j, k, 3) at the places of its nodes, along the coordinates' axes."""
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = matrix * STEP, origin
    nodes = np.stack(np.meshgrid(*map(np.arange, COUNTS), indexing="ij"), axis=-1)
    return affine, flow(1e-3 * (nodes @ affine[:3, :3].T + origin))


TURN = np.linalg.qr(np.array([[1.0, 0.3, -0.2], [-0.3, 1.0, 0.4], [0.2, -0.3, 1.0]]))[0]
TURN = TURN * np.sign(np.diag(TURN))
MATRICES = {
    "straight": np.eye(3),
    "flipped": np.diag([1.0, -1.0, 1.0]),
    "permuted and flipped": np.array([[0.0, 0, 1], [-1, 0, 0], [0, 1, 0]]),
    "oblique": TURN,
}
ORIGIN = np.array([-10.0, 5.0, 12.0])


def check(recording, turn: np.ndarray, mirror: np.ndarray | None = None) -> None:
    """Every value is the flow at its place, in coordinates turned back by `turn` and mirrored from the file's."""
    mirror = np.ones(3) if mirror is None else mirror
    nodes = recording.grid.nodes().numpy()
    expected = (flow((nodes @ turn.T) * mirror) * mirror) @ turn
    inside = recording.mask[0].ravel()
    assert inside.all()
    np.testing.assert_allclose(recording.velocity[0].reshape(3, -1).T, expected, atol=2e-5)


@pytest.mark.parametrize("name", MATRICES)
def test_nifti_directions_turn_places_and_components(tmp_path: Path, name: str) -> None:
    nibabel = pytest.importorskip("nibabel", reason=EXTRA)
    affine, values = placed(MATRICES[name], ORIGIN)
    image = nibabel.Nifti1Image(values[:, :, :, None].astype(np.float64), affine)
    image.header.set_xyzt_units("mm", "msec")
    nibabel.save(image, tmp_path / "flow.nii.gz")
    recording = convert([tmp_path / "flow.nii.gz"]).recording
    mirror = np.array([-1.0, -1.0, 1.0])
    turn = mirror[:, None] * TURN * mirror if name == "oblique" else np.eye(3)
    check(recording, turn, mirror)
    assert set(recording.grid.spacing) == set(np.round(1e-3 * STEP, 12)) or np.allclose(
        sorted(recording.grid.spacing), 1e-3 * STEP
    )
    assert [one for one in findings(recording) if one.dataset == "/velocity"] == []


@pytest.mark.parametrize("name", MATRICES)
def test_nrrd_and_metaimage_directions(tmp_path: Path, name: str) -> None:
    nrrd, sitk = pytest.importorskip("nrrd", reason=EXTRA), pytest.importorskip("SimpleITK", reason=EXTRA)
    affine, values = placed(MATRICES[name], ORIGIN)
    header = {
        "space": "left-posterior-superior",
        "kinds": ["vector", "domain", "domain", "domain"],
        "space directions": np.array([np.full(3, np.nan), *affine[:3, :3].T]),
        "space origin": ORIGIN,
    }
    nrrd.write(str(tmp_path / "flow.nrrd"), np.moveaxis(values, -1, 0), header)
    image = sitk.GetImageFromArray(values.transpose(2, 1, 0, 3), isVector=True)
    image.SetSpacing(STEP.tolist())
    image.SetOrigin(ORIGIN.tolist())
    image.SetDirection(MATRICES[name].ravel().tolist())
    sitk.WriteImage(image, str(tmp_path / "flow.mha"))
    for file in ("flow.nrrd", "flow.mha"):
        check(convert([tmp_path / file]).recording, TURN if name == "oblique" else np.eye(3))


def test_components_along_the_image_are_turned_too(tmp_path: Path) -> None:
    nrrd = pytest.importorskip("nrrd", reason=EXTRA)
    for name, matrix in MATRICES.items():
        affine, values = placed(matrix, ORIGIN)
        header = {
            "space": "left-posterior-superior",
            "kinds": ["vector", "domain", "domain", "domain"],
            "space directions": np.array([np.full(3, np.nan), *affine[:3, :3].T]),
            "space origin": ORIGIN,
        }
        nrrd.write(str(tmp_path / "flow.nrrd"), np.moveaxis(values @ matrix, -1, 0), header)
        recording = convert([tmp_path / "flow.nrrd"], FieldMap(image_components=True)).recording
        check(recording, TURN if name == "oblique" else np.eye(3))


def test_walls_are_turned_with_an_oblique_image(tmp_path: Path) -> None:
    nrrd = pytest.importorskip("nrrd", reason=EXTRA)
    affine, values = placed(TURN, ORIGIN)
    header = {
        "space": "left-posterior-superior",
        "kinds": ["vector", "domain", "domain", "domain"],
        "space directions": np.array([np.full(3, np.nan), *affine[:3, :3].T]),
        "space origin": ORIGIN,
    }
    nrrd.write(str(tmp_path / "flow.nrrd"), np.moveaxis(values, -1, 0), header)
    centre = affine[:3, :3] @ [4, 3.5, 3] + ORIGIN
    ball = ellipsoid((6.0, 6.0, 6.0), 1.0)
    write_surface(tmp_path / "wall.ply", Surface(ball.vertices + centre, ball.faces))
    recording = convert([tmp_path / "flow.nrrd"], wall=WallOptions((str(tmp_path / "wall.ply"),), "mm")).recording
    middle = recording.wall.vertices.mean(axis=0)
    np.testing.assert_allclose(middle @ TURN.T, 1e-3 * centre, atol=1e-6)
    assert recording.mask.sum() == pytest.approx(recording.wall.at(0).volume / recording.grid.cell_volume, rel=0.2)


def field_file(path: Path, **more: object) -> np.ndarray:
    """A file as 4D-flow tools write it: x, y, z order, mm, cm/s, a mask of reals."""
    _, values = placed(np.eye(3), np.zeros(3))
    with h5py.File(path, "w") as file:
        for component, name in enumerate("uvw"):
            file[name] = (100 * values[None, ..., component]).astype(np.float32)
        mask = np.zeros((1, *COUNTS), np.float32)
        mask[:, 1:-1, 1:-1, 1:] = 1  # cut where k ends
        file["mask"], file["dx"] = mask, STEP[None]
        for name, value in more.items():
            file[name] = value
    return values


SAID = FieldMap(velocity=("u", "v", "w"), mask="mask", spacing="dx", length_unit="mm", velocity_unit="cm/s", axes="xyz")


def test_hdf5_of_any_layout_by_a_field_map(tmp_path: Path) -> None:
    values = field_file(tmp_path / "f.h5")
    result = convert([tmp_path / "f.h5"], SAID)
    recording = result.recording
    assert recording.grid.shape == (7, 8, 9) and recording.grid.spacing == pytest.approx(1e-3 * STEP)
    np.testing.assert_allclose(recording.velocity[0, :, 3, 2, 4], values[4, 2, 3], rtol=1e-5)
    assert set(np.unique(recording.wall.region)) == {0, 1}
    cut = recording.wall.at(0).centroids[recording.wall.region == 1]
    assert cut[:, 2].min() > recording.grid.upper[2]
    assert any("regions [1]" in note for note in result.notes)


def test_the_order_of_least_divergence_is_found(tmp_path: Path) -> None:
    values = field_file(tmp_path / "f.h5")
    from dataclasses import replace

    result = convert([tmp_path / "f.h5"], replace(SAID, axes="auto"))
    np.testing.assert_allclose(result.recording.velocity[0, :, 3, 2, 4], values[4, 2, 3], rtol=1e-5)
    assert "axes taken as xyz" in result.notes[0]
    wrong = convert([tmp_path / "f.h5"], replace(SAID, axes="zyx")).recording
    assert any("divergence" in one.rule for one in findings(wrong))


def test_a_field_map_file(tmp_path: Path) -> None:
    lines = ['velocity = ["u", "v", "w"]', 'mask = "mask"', 'spacing = "dx"', 'axes = "xyz"']
    (tmp_path / "map.toml").write_text("\n".join([*lines, 'length_unit = "mm"', 'velocity_unit = "cm/s"']))
    assert read_field_map(tmp_path / "map.toml") == SAID
    for text, message in (
        ("velocty = 'u'", "unknown key velocty"),
        ("x", "is no TOML"),
        ("axes = 'xx'", "axes: must name"),
    ):
        (tmp_path / "map.toml").write_text(text)
        with pytest.raises(FormatError, match=f"map.toml: {message}"):
            read_field_map(tmp_path / "map.toml")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"velocity": ()}, "which arrays are the velocity.*--velocity"),
        ({"velocity": ("u", "v", "q")}, r"has no array q; it holds dx \(1, 3\)"),
        ({"velocity": ("u", "v")}, "3 components of velocity are needed, not 2"),
        ({"spacing": ""}, "how far are its nodes apart"),
        ({"length_unit": ""}, "in which unit are its lengths"),
        ({"components": "x,y,y"}, "must name each axis once"),
        ({"time": (0.0, 1.0)}, "2 times for 1 frames"),
    ],
)
def test_what_is_not_said_is_asked_for(tmp_path: Path, change: dict, message: str) -> None:
    from dataclasses import replace

    field_file(tmp_path / "f.h5")
    with pytest.raises(FormatError, match=f"f.h5: .*{message}|components: {message}"):
        convert([tmp_path / "f.h5"], replace(SAID, **change))


def test_a_file_that_claims_too_much_is_refused_before_it_is_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "huge.h5", "w") as file:
        for name in "uvw":
            file.create_dataset(name, (1000, 4000, 4000, 4000), "f4", chunks=(1, 10, 10, 10))
    said = FieldMap(velocity=("u", "v", "w"), spacing=(1.0,), length_unit="mm", interval=0.01)
    with pytest.raises(FormatError, match="more than memory holds"):
        convert([tmp_path / "huge.h5"], said)


def test_packed_values_and_stated_units_of_datasets(tmp_path: Path) -> None:
    from dataclasses import replace

    values = field_file(tmp_path / "f.h5")
    with h5py.File(tmp_path / "f.h5", "r+") as file:
        for name in "uvw":
            counts = np.rint(file[name][()] / 0.01).astype(np.int16)
            counts[0, 2, 2, 2] = -32768
            del file[name]
            file[name] = counts
            file[name].attrs.update(scale_factor=0.01, add_offset=0.0, _FillValue=np.int16(-32768), units="cm/s")
    recording = convert([tmp_path / "f.h5"], replace(SAID, velocity_unit="")).recording
    np.testing.assert_allclose(recording.velocity[0, :, 3, 2, 4], values[4, 2, 3], atol=1e-4)
    assert recording.weight[0, 2, 2, 2] == 0 and recording.weight[0, 3, 3, 3] == 1


def test_matlab_of_both_kinds(tmp_path: Path) -> None:
    from scipy.io import savemat

    _, values = placed(np.eye(3), np.zeros(3))
    series = np.stack([values, 2 * values], axis=3)  # x, y, z, t, component
    fields = {name: series[..., number] for number, name in enumerate("uvw")}
    savemat(tmp_path / "five.mat", fields)
    with h5py.File(tmp_path / "seven.mat", "w", userblock_size=512) as file:
        for name, field in fields.items():
            file[name] = field.T  # MATLAB stores its arrays in HDF5 with the axes reversed
    said = FieldMap(velocity=("u", "v", "w"), spacing=tuple(STEP), length_unit="mm", interval=0.02, nyquist=1.5)
    for name in ("five.mat", "seven.mat"):
        recording = convert([tmp_path / name], said).recording
        assert recording.nyquist.tolist() == [1.5, 1.5]
        np.testing.assert_allclose(recording.velocity[1, :, 3, 2, 4], 2 * values[4, 2, 3], rtol=1e-5)
        assert recording.time.tolist() == [0, 0.02] and recording.grid.shape == (7, 8, 9)


def test_davis_text_with_decimal_commas(tmp_path: Path) -> None:
    rows = ['#DaVis 8.1.6 2D-vector 32 4 3 "position" "mm" "position" "mm" "velocity" "m/s"']
    for y in (3.0, 1.5, 0.0):
        for x in (0.5, 1.5, 2.5, 3.5):
            u, v = (0.0, 0.0) if (x, y) == (3.5, 3.0) else (0.1 * x, -0.2 * y + 0.01)
            rows.append("\t".join(f"{value:g}".replace(".", ",") for value in (x, y, u, v)))
    (tmp_path / "B1.txt").write_text("\n".join(rows) + "\n")
    recording = convert([tmp_path / "B1.txt"]).recording
    assert recording.dimension == 2 and recording.grid.spacing == pytest.approx((1e-3, 1.5e-3))
    assert recording.grid.origin == pytest.approx((0.5e-3, 0))
    np.testing.assert_allclose(recording.velocity[0, :, 1, 2], [0.25, -0.29], rtol=1e-6)
    assert recording.mask.sum() == 11 and not recording.mask[0, 2, 3]


def test_openpiv_text_needs_its_scale(tmp_path: Path) -> None:
    rows = [f"{16 * i} {16 * j} {0.5 * i} {-0.25 * j} 9.0" for j in range(1, 4) for i in range(1, 5)]
    (tmp_path / "exp.txt").write_text("\n".join(rows))
    with pytest.raises(FormatError, match="in which unit are its lengths"):
        convert([tmp_path / "exp.txt"])
    recording = convert([tmp_path / "exp.txt"], FieldMap(length_unit="2e-5", velocity_unit="0.01")).recording
    assert recording.grid.spacing == pytest.approx((3.2e-4, 3.2e-4))
    np.testing.assert_allclose(recording.velocity[0, :, 1, 2], [0.015, -0.005], rtol=1e-6)


def test_tracks_are_averaged_around_nodes(tmp_path: Path) -> None:
    draw = np.random.default_rng(0)
    points = draw.uniform(0, 40, (4000, 3))
    velocity = flow(1e-3 * points)
    frame = draw.integers(0, 4, 4000)
    table = np.c_[np.arange(4000), points, velocity, np.zeros((4000, 3)), frame]
    np.savetxt(tmp_path / "tracks", table, fmt="%.8g")
    said = FieldMap(length_unit="mm", time_unit="ms", grid_spacing=0.005, bin=2)
    recording = convert([tmp_path / "tracks"], said, format="tracks").recording
    assert recording.frames == 2 and recording.grid.spacing == pytest.approx((0.005,) * 3)
    nodes = recording.grid.nodes().numpy()
    inner = ((nodes > 0.004) & (nodes < 0.036)).all(axis=1)
    error = recording.velocity[0].reshape(3, -1).T[inner] - flow(nodes[inner])
    assert np.abs(error).mean() < 0.03  # half a cell of the steepest gradient is .075 m/s
    assert recording.weight.mean() > 0.5
    with pytest.raises(FormatError, match="has 11 columns, but 7 are named"):
        convert([tmp_path / "tracks"], FieldMap(columns="x,y,z,u,v,w,t", grid_spacing=0.005), format="tracks")


def _series(folder: Path, suffix: str) -> tuple[list[Path], list[float]]:
    pipe = tube(8.0, 30.0, 2.0)
    side = pipe.faces[pipe.region == 0]
    files, radii = [], [1.0, 1.05, 1.1, 1.05]
    for number, scale in enumerate(radii):
        path = folder / f"wall_{number}{suffix}"
        write_surface(path, Surface(pipe.vertices * [scale, scale, 1], side))
        files.append(path)
    return files, [scale**2 * 1e-9 * pipe.volume for scale in radii]


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply"])
def test_series_of_open_walls_keep_their_triangles(tmp_path: Path, suffix: str) -> None:
    files, volumes = _series(tmp_path, suffix)
    said = FieldMap(length_unit="mm", grid_spacing=0.003, period=0.8)
    recording = convert(files, said, wall=WallOptions(openings=2)).recording
    assert [recording.wall.at(frame).volume for frame in range(4)] == pytest.approx(volumes, rel=1e-4)
    assert set(np.unique(recording.wall.region)) == {0, 1, 2} and recording.period == 0.8
    assert recording.time == pytest.approx([0, 0.2, 0.4, 0.6]) and not recording.weight.any()
    other = ellipsoid((8.0, 8.0, 8.0), 2.0)
    write_surface(tmp_path / f"wall_9{suffix}", other)
    with pytest.raises(FormatError, match="has other faces than"):
        convert([*files, tmp_path / f"wall_9{suffix}"], said)


def test_walls_in_the_wrong_unit_are_refused(tmp_path: Path) -> None:
    files, _ = _series(tmp_path, ".ply")
    with pytest.raises(SurfaceError, match="is 30 m large, so it is probably in mm"):
        convert(files, FieldMap(grid_spacing=0.003, period=0.8))


@pytest.mark.parametrize("package", ["nibabel", "nrrd", "SimpleITK", "xarray", "vtkmodules"])
def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    import sys

    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    suffix = {"nibabel": "nii", "nrrd": "nrrd", "SimpleITK": "mha", "xarray": "nc", "vtkmodules": "vti"}[package]
    (tmp_path / f"a.{suffix}").write_bytes(b"")
    with pytest.raises(FormatError, match=r'needs the package .*: python -m pip install "torchsph\[formats\]"'):
        convert([tmp_path / f"a.{suffix}"])


def test_files_that_are_none_of_their_format_are_named(tmp_path: Path) -> None:
    for name in ("a.h5", "a.mat", "a.npz", "a.nii", "a.nrrd", "a.mha", "a.vti", "a.nc", "a.txt"):
        (tmp_path / name).write_text("nothing of the kind")
        with pytest.raises(FormatError, match=name):
            convert([tmp_path / name])
    with pytest.raises(FormatError, match="which format is it"):
        convert([_named(tmp_path)])
    with pytest.raises(FileNotFoundError, match="nowhere"):
        convert([tmp_path / "nowhere.h5"])


def _named(folder: Path) -> Path:
    (folder / "a.xyz").write_text("x")
    return folder / "a.xyz"
