"""A wall that turns and stretches, by a field of displacements in several formats and by one for each vertex."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from geometry import Grid, Recording, Surface, ellipsoid, read_recording, tube, write_surface
from geometry.formats import FieldMap, FormatError, MotionOptions, WallOptions, convert, export
from torchsph.cli import main as torchsph

EXTRA = "the extra `formats` is not installed"
TIME = np.array([0.0, 0.1, 0.2, 0.3])
PERIOD = 0.4
CENTRE = np.array([12.0, 8.0, -5.0])  # mm
COUNTS, STEP = (17, 15, 16), np.array([2.5, 3.0, 2.75])  # of the field, mm
TURN = np.linalg.qr(np.array([[1.0, 0.3, -0.2], [-0.3, 1.0, 0.4], [0.2, -0.3, 1.0]]))[0]
TURN = TURN * np.sign(np.diag(TURN))


def gradient(time: float) -> np.ndarray:
    """The deformation at a time: a turn about z by .2 rad, a stretch by 10 % along z and a squeeze across."""
    phase = np.sin(2 * np.pi * time / PERIOD)
    c, s = np.cos(0.2 * phase), np.sin(0.2 * phase)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return turn @ np.diag([1 - 0.05 * phase, 1 - 0.08 * phase, 1 + 0.1 * phase])


def displaced(points: np.ndarray, time: float) -> np.ndarray:
    """Displacements, mm, of points, mm."""
    return (points - CENTRE) @ (gradient(time) - np.eye(3)).T


@pytest.fixture(name="ball")
def _ball(tmp_path: Path) -> Surface:
    ball = ellipsoid((9.0, 11.0, 14.0), 3.0)
    surface = Surface(ball.vertices + CENTRE, ball.faces)
    write_surface(tmp_path / "wall.ply", surface)
    return surface


def lattice(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Affine, first node and nodes (i, j, k, 3), mm, of a field around the ball."""
    half = 0.5 * (np.array(COUNTS) - 1) * STEP
    origin = CENTRE - matrix @ half
    nodes = np.stack(np.meshgrid(*map(np.arange, COUNTS), indexing="ij"), axis=-1)
    return matrix * STEP, origin, nodes @ (matrix * STEP).T + origin


def _nrrd(folder: Path, matrix: np.ndarray) -> MotionOptions:
    nrrd = pytest.importorskip("nrrd", reason=EXTRA)
    steps, origin, nodes = lattice(matrix)
    nothing = np.full(3, np.nan)
    header = {
        "space": "left-posterior-superior",
        "kinds": ["vector", "domain", "domain", "domain", "list"],
        "space directions": np.array([nothing, *steps.T, nothing]),
        "space origin": origin,
    }
    values = np.stack([np.moveaxis(displaced(nodes, time), -1, 0) for time in TIME], axis=-1)
    nrrd.write(str(folder / "u.nrrd"), values, header)
    return MotionOptions((str(folder / "u.nrrd"),), FieldMap(interval=0.1))


def _nifti(folder: Path, matrix: np.ndarray) -> MotionOptions:
    """RAS coordinates and components, as the format asks, times in ms."""
    nibabel = pytest.importorskip("nibabel", reason=EXTRA)
    mirror = np.diag([-1.0, -1.0, 1.0])
    steps, origin, nodes = lattice(matrix)
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = mirror @ steps, mirror @ origin
    values = np.stack([displaced(nodes, time) @ mirror for time in TIME], axis=3)
    image = nibabel.Nifti1Image(values, affine)
    image.header.set_xyzt_units("mm", "msec")
    image.header["pixdim"][4] = 100
    nibabel.save(image, folder / "u.nii.gz")
    return MotionOptions((str(folder / "u.nii.gz"),))


def _metaimages(folder: Path, matrix: np.ndarray) -> MotionOptions:
    """A displacement field of each frame as ITK's registrations write them."""
    sitk = pytest.importorskip("SimpleITK", reason=EXTRA)
    _, origin, nodes = lattice(matrix)
    files = []
    for number, time in enumerate(TIME):
        image = sitk.GetImageFromArray(displaced(nodes, time).transpose(2, 1, 0, 3), isVector=True)
        image.SetSpacing(STEP.tolist())
        image.SetOrigin(origin.tolist())
        image.SetDirection(matrix.ravel().tolist())
        files.append(str(folder / f"u_{number}.mha"))
        sitk.WriteImage(image, files[-1])
    return MotionOptions(tuple(files))


def _archive(folder: Path, matrix: np.ndarray) -> MotionOptions:
    """Arrays alone, in cm; everything is said."""
    if (matrix != np.eye(3)).any():
        pytest.skip("an archive has no directions")
    _, origin, nodes = lattice(matrix)
    values = np.stack([displaced(nodes, time) for time in TIME])
    np.savez(folder / "u.npz", u=0.1 * values, when=1e3 * TIME)
    said = FieldMap(
        velocity=("u",),
        axes="txyzc",
        spacing=tuple(STEP),
        origin=tuple(origin),
        length_unit="mm",
        time="when",
        time_unit="ms",
    )
    return MotionOptions((str(folder / "u.npz"),), said, "cm")


FIELDS: list[Callable[[Path, np.ndarray], MotionOptions]] = [_nrrd, _nifti, _metaimages, _archive]


def expected(ball: Surface) -> np.ndarray:
    """Vertices (T, n, 3), m."""
    return 1e-3 * np.stack([ball.vertices + displaced(ball.vertices, time) for time in TIME])


@pytest.mark.parametrize("write", FIELDS)
@pytest.mark.parametrize("matrix", [np.eye(3), TURN], ids=["straight", "oblique"])
def test_a_field_of_displacements_moves_the_wall(tmp_path: Path, ball: Surface, write: Callable, matrix: np.ndarray):
    motion = write(tmp_path, matrix)
    said = FieldMap(length_unit="mm", grid_spacing=0.005, period=PERIOD)
    found = convert([tmp_path / "wall.ply"], said, wall=WallOptions(motion=motion)).recording
    np.testing.assert_allclose(found.wall.vertices, expected(ball), atol=2e-7)
    np.testing.assert_allclose(found.time, TIME, atol=1e-7)
    volumes = [found.wall.at(frame).volume for frame in range(4)]
    ratio = [np.linalg.det(gradient(time)) for time in TIME]
    np.testing.assert_allclose(volumes, 1e-9 * ball.volume * np.array(ratio), rtol=1e-5)


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 1, 0)])
def test_displacements_of_vertices_move_the_wall(tmp_path: Path, ball: Surface, order: tuple[int, ...]) -> None:
    values = np.stack([displaced(ball.vertices, time) for time in TIME])
    np.savez(tmp_path / "u.npz", u=values.transpose(order))
    motion = MotionOptions((str(tmp_path / "u.npz"),), FieldMap(velocity=("u",)))
    said = FieldMap(length_unit="mm", grid_spacing=0.005, period=PERIOD)
    found = convert([tmp_path / "wall.ply"], said, wall=WallOptions(motion=motion)).recording
    np.testing.assert_allclose(found.wall.vertices, expected(ball), atol=2e-7)
    np.testing.assert_allclose(found.time, TIME, atol=1e-12)


def test_openings_of_a_moved_wall_stay_between_their_rims(tmp_path: Path) -> None:
    pipe = tube(8.0, 30.0, 2.0)
    side = Surface(pipe.vertices, pipe.faces[pipe.region == 0])
    write_surface(tmp_path / "pipe.ply", side)
    raw = np.unique(side.faces)  # vertices of the caps are in the file but of no face
    values = np.stack([pipe.vertices * [scale - 1, scale - 1, 0] for scale in (1.0, 1.1)])
    assert len(raw) < values.shape[1]
    np.savez(tmp_path / "u.npz", u=values)
    motion = MotionOptions((str(tmp_path / "u.npz"),), FieldMap(velocity=("u",), interval=0.1))
    said = FieldMap(length_unit="mm", grid_spacing=0.003)
    wall = WallOptions(openings=2, motion=motion)
    found = convert([tmp_path / "pipe.ply"], said, wall=wall).recording
    assert [found.wall.at(frame).volume for frame in (0, 1)] == pytest.approx(
        [1e-9 * pipe.volume, 1.21e-9 * pipe.volume], rel=1e-4
    )
    assert set(np.unique(found.wall.region)) == {0, 1, 2}


def flow(tmp_path: Path, time: np.ndarray) -> Path:
    grid = Grid(tuple(1e-3 * (CENTRE - 18)), (3e-3,) * 3, (13, 13, 13))
    velocity = np.full((len(time), 3, *grid.shape), 0.1, np.float32)
    blank = Recording(time, grid, velocity, np.ones(grid.shape, bool), None, 1060.0, 0.004, period=PERIOD)
    return export(blank, tmp_path / "flow", "npz")[0]


SAID = FieldMap(velocity=("velocity",), time="time", axes="tczyx", length_unit="m", spacing=(3e-3,), period=PERIOD)


def test_frames_of_the_flow_fall_between_those_of_the_motion(tmp_path: Path, ball: Surface) -> None:
    motion = _archive(tmp_path, np.eye(3))
    time = np.array([0.0, 0.05, 0.2, 0.35])
    wall = WallOptions((str(tmp_path / "wall.ply"),), "mm", motion=motion)
    said = replace(SAID, origin=tuple(1e-3 * (CENTRE - 18)))
    found = convert([flow(tmp_path, time)], said, wall=wall).recording
    own = expected(ball)
    middle = [own[0], 0.5 * (own[0] + own[1]), own[2], 0.5 * (own[3] + own[0])]
    np.testing.assert_allclose(found.wall.vertices, middle, atol=2e-7)
    with pytest.raises(FormatError, match="do not cover the frames from 0 to 0.35 s"):
        convert([tmp_path / "flow.npz"], replace(said, period=0.0), wall=wall)


def test_vertices_outside_of_the_field_are_refused(tmp_path: Path, ball: Surface) -> None:
    motion = _archive(tmp_path, np.eye(3))
    write_surface(tmp_path / "far.ply", Surface(ball.vertices + [15, 0, 0], ball.faces))
    said = FieldMap(length_unit="mm", grid_spacing=0.005, period=PERIOD)
    with pytest.raises(FormatError, match=r"u\.npz: \d+ of \d+ vertices of the wall lie outside of the field .* mm"):
        convert([tmp_path / "far.ply"], said, wall=WallOptions(motion=motion))
    with pytest.raises(FormatError, match="lie outside of the field"):  # a wall in m beside a field in mm
        write_surface(tmp_path / "m.ply", Surface(1e-3 * ball.vertices - 0.1, ball.faces))
        convert([tmp_path / "m.ply"], replace(said, length_unit="m"), wall=WallOptions(motion=motion))
    values = dict(np.load(tmp_path / "u.npz"))
    values["u"][:, 8, 7, 3] = np.nan
    np.savez(tmp_path / "u.npz", **values)
    with pytest.raises(FormatError, match="vertices of the wall lie beside nodes without a value"):
        convert([tmp_path / "wall.ply"], said, wall=WallOptions(motion=motion))


def test_displacements_need_one_surface_and_times(tmp_path: Path, ball: Surface) -> None:
    values = np.stack([displaced(ball.vertices, time) for time in TIME])
    np.savez(tmp_path / "u.npz", u=values)
    motion = MotionOptions((str(tmp_path / "u.npz"),), FieldMap(velocity=("u",)))
    said = FieldMap(length_unit="mm", grid_spacing=0.005)
    with pytest.raises(FormatError, match="when were the 4 walls"):
        convert([tmp_path / "wall.ply"], said, wall=WallOptions(motion=motion))
    with pytest.raises(FormatError, match="has one surface"):
        convert([tmp_path / "wall.ply"] * 2, said, wall=WallOptions(motion=motion))
    file = flow(tmp_path, TIME[:3])
    with pytest.raises(FormatError, match="moves a wall: name its surface"):
        convert([file], SAID, wall=WallOptions(motion=motion))
    wall = WallOptions((str(tmp_path / "wall.ply"),), "mm", motion=motion)
    with pytest.raises(FormatError, match="has 4 frames of displacements without times, the velocity 3"):
        convert([file], replace(SAID, origin=(0.0, 0.0, 0.0)), wall=wall)


def test_the_command_line_moves_a_wall(tmp_path: Path, ball: Surface) -> None:
    np.savez(tmp_path / "u.npz", u=np.stack([displaced(ball.vertices, time) for time in TIME]))
    line = f"convert {tmp_path}/wall.ply --length-unit mm --grid-spacing 0.005 --period 0.4 --motion {tmp_path}/u.npz "
    assert torchsph([*f"{line}--motion-arrays u --motion-unit mm --out {tmp_path}/m.h5".split()]) in (0, None)
    np.testing.assert_allclose(read_recording(tmp_path / "m.h5").wall.vertices, expected(ball), atol=2e-7)


def test_the_unit_that_an_array_states_is_taken(tmp_path: Path, ball: Surface) -> None:
    said = FieldMap(length_unit="mm", grid_spacing=0.005, period=PERIOD)
    values = np.stack([displaced(ball.vertices, time) for time in TIME])
    motion = MotionOptions((str(tmp_path / "u.h5"),), FieldMap(velocity=("u",)))
    for unit, per in (("cm", 0.1), ("m", 1e-3), ("furlong", 1.0)):
        with h5py.File(tmp_path / "u.h5", "w") as file:
            file["u"] = per * values
            file["u"].attrs["units"] = unit
        if unit == "furlong":
            with pytest.raises(FormatError, match="u: its attribute units: 'furlong' is no unit of length"):
                convert([tmp_path / "wall.ply"], said, wall=WallOptions(motion=motion))
            continue
        found = convert([tmp_path / "wall.ply"], said, wall=WallOptions(motion=motion)).recording
        np.testing.assert_allclose(found.wall.vertices, expected(ball), atol=2e-7)
