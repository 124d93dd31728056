"""Each kind of odd data through the command line: told with its dataset, rule and cure, and refused by --strict.

Files are made for the purpose. What cannot be meant is refused by every command and by `write_recording`; what may be
meant is told, and refused by `--strict` and by `write_recording(strict=True)`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import geometry
from geometry import Grid, Recording, RecordingError, Wall, read_recording, write_recording
from torchsph.cli import main as torchsph

TIMES = tuple(np.arange(6) * 0.01)


def straining(points: np.ndarray, _: float) -> np.ndarray:
    """A steady flow without divergence whose components differ."""
    x, y, z = (points - 0.005).T
    return np.stack([40 * x - 10 * y, 10 * x + 20 * y, -60 * z + 5 * x], axis=1) + 0.05


@pytest.fixture(name="sound")
def _sound(box_recording: Callable[..., Recording]) -> Recording:
    recording = box_recording(straining, times=TIMES, wall_velocity=lambda vertices: 0.01 * vertices)
    enclosed = np.array([recording.wall.at(frame).volume for frame in range(recording.frames)])
    rate = np.gradient(enclosed, recording.time)
    return replace(recording, volume=enclosed, flux_mitral=rate, flux_aortic=0 * rate)


def scaled(recording: Recording, *, length: float = 1.0, time: float = 1.0) -> Recording:
    grid = recording.grid
    ends = (tuple(length * np.array(part)) for part in (grid.origin, grid.spacing))
    wall = Wall(recording.wall.vertices * length, recording.wall.faces, recording.wall.region)
    bare = replace(recording, volume=None, flux_mitral=None, flux_aortic=None)
    return replace(bare, grid=Grid(*ends, grid.shape), wall=wall, time=recording.time * time)


def moved(recording: Recording, shift: float) -> Recording:
    wall = recording.wall
    bare = replace(recording, volume=None, flux_mitral=None, flux_aortic=None)
    return replace(bare, wall=Wall(wall.vertices + [shift, 0, 0], wall.faces, wall.region))


def constant_error(recording: Recording, value: float) -> Recording:
    return replace(recording, sigma=np.full(recording.velocity.shape, value, np.float32))


def flickering(recording: Recording) -> Recording:
    noise = np.random.default_rng(0).normal(0, 2e-4, recording.wall.vertices.shape)
    wall = Wall(recording.wall.vertices + noise, recording.wall.faces, recording.wall.region)
    return replace(recording, wall=wall, flux_mitral=None, flux_aortic=None)


def outlying(recording: Recording) -> Recording:
    velocity = recording.velocity.copy()
    velocity[1, 0, 4, 4, 4] = 10.0
    return replace(recording, velocity=velocity)


def aliased(recording: Recording) -> Recording:
    """A shear that reaches 2 m/s, of which a scanner with a limit of 1.2 m/s sees what is left."""
    step = 0.01 / 24
    grid = Grid((-0.5 * step,) * 3, (step,) * 3, (26,) * 3)
    points = grid.nodes().numpy()
    mask = ((points > 0) & (points < 0.01)).all(1).reshape(grid.shape)
    velocity = np.zeros((recording.frames, 3, *grid.shape), np.float32)
    velocity[:, 2] = ((400 * (points[:, 0] - 0.005) + 1.2) % 2.4 - 1.2).reshape(grid.shape) * mask
    return replace(recording, grid=grid, velocity=velocity, mask=mask)


def overlapping(recording: Recording) -> Recording:
    balls = [geometry.ellipsoid((0.004,) * 3, 0.0015, (0.005 + shift, 0.005, 0.005)) for shift in (-0.002, 0.002)]
    vertices = np.concatenate([ball.vertices for ball in balls])
    faces = np.concatenate([balls[0].faces, balls[1].faces + len(balls[0].vertices)])
    bare = replace(recording, volume=None, flux_mitral=None, flux_aortic=None)
    return replace(bare, wall=Wall(vertices, faces, np.zeros(len(faces), np.uint8)))


@dataclass(frozen=True)
class Odd:
    """How a sound recording becomes odd, and what must be said: dataset, rule, cure; refused or told."""

    change: Callable[[Recording], Recording]
    dataset: str
    rule: str
    cure: str
    severe: bool = False


ODD = {
    "lengths in mm": Odd(lambda r: scaled(r, length=1e3), "/grid", "is 11.25 m large", "in metres", True),
    "lengths in cm": Odd(lambda r: scaled(r, length=1e2), "/grid", "is 1.125 m large", "in metres", True),
    "lengths in km": Odd(lambda r: scaled(r, length=5e-2), "/grid", "is only 0.563 mm large", "in metres"),
    "times in ms": Odd(lambda r: scaled(r, time=1e3), "/time", "frames are 10 s apart", "in seconds", True),
    "a beat of 450 s": Odd(lambda r: replace(r, period=450.0), "period", "is 450 s, no beat", "in seconds", True),
    "speeds in mm/s": Odd(
        lambda r: replace(r, velocity=1e3 * r.velocity), "/velocity", "above 20 m/s", "convert it to m/s", True
    ),
    "speeds that no valve makes": Odd(outlying, "/velocity", "faster than the jets", "in cm/s or mm/s"),
    "speeds converted twice": Odd(
        lambda r: replace(r, velocity=1e-4 * r.velocity), "/velocity", "stays below", "in m/s"
    ),
    "errors of 1e19": Odd(lambda r: constant_error(r, 1e19), "/sigma", "reaches 1e+19 m/s", "give m/s", True),
    "errors of 50 m/s": Odd(lambda r: constant_error(r, 50.0), "/sigma", "reaches 50 m/s", "/weight 0"),
    "errors of zero": Odd(
        lambda r: constant_error(r, 0.0), "/sigma", "claims that they are exact", "leave /sigma out", True
    ),
    "components swapped": Odd(
        lambda r: replace(r, velocity=r.velocity[:, [2, 1, 0]]), "/velocity", "components were z,y,x", "--components"
    ),
    "a component turned over": Odd(
        lambda r: replace(r, velocity=r.velocity * np.array([1, -1, 1]).reshape(1, 3, 1, 1, 1)),
        "/velocity",
        "components were x,-y,z",
        "--axes",
    ),
    "axes in the other order": Odd(
        lambda r: replace(r, velocity=r.velocity.transpose(0, 1, 4, 3, 2)), "/velocity", "its divergence is", "--axes"
    ),
    "a mask half a body aside": Odd(lambda r: moved(r, 0.0025), "/mask", "25 % of the nodes", "same coordinates"),
    "a mask elsewhere": Odd(lambda r: moved(r, 0.008), "/mask", "lie outside the wall", "same coordinates", True),
    "bodies that overlap": Odd(overlapping, "/wall/faces", "its bodies overlap", "--unite", True),
    "a volume in ml": Odd(
        lambda r: replace(r, volume=1e6 * r.volume), "/volume", "where the wall encloses", "ml times 1e-6"
    ),
    "fluxes the other way": Odd(
        lambda r: replace(r, flux_mitral=-r.flux_mitral), "/flux/mitral", "miss the change of the wall's volume", "m3/s"
    ),
    "valves that open at other times": Odd(
        lambda r: replace(r, valve_intervals=np.array([[1, 10.0, 30.0]])),
        "/valve/intervals",
        "open from 10 to 30 s, far from every frame",
        "in seconds",
    ),
    "a valve open for longer than a beat": Odd(
        lambda r: replace(r, period=0.8, valve_intervals=np.array([[1, 0.0, 450.0]])),
        "/valve/intervals",
        "longer than the period",
        "in seconds",
    ),
    "little coverage": Odd(
        lambda r: replace(r, weight=(np.arange(10) < 2) * np.ones(r.mask.shape, np.float32)),
        "/weight",
        "only 12 % of the nodes",
        "belong together",
    ),
    "a frame of nothing": Odd(
        lambda r: replace(r, velocity=np.where((np.arange(6) == 2).reshape(6, 1, 1, 1, 1), 0, r.velocity)),
        "/velocity",
        "is 0 everywhere in 1 of 6 frames",
        "/weight 0",
    ),
    "a wall that flickers": Odd(flickering, "/wall/vertices", "the wall flickers", "smooth the wall"),
    "aliased speeds": Odd(aliased, "/velocity", "have wrapped at", "unwrap them"),
}


def unchecked(path: Path, recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file as another program would write it: without our checks."""
    with monkeypatch.context() as patched:
        patched.setattr(geometry.recordings.write, "refuse_implausible", lambda *_, **__: None)
        patched.setattr(geometry.recordings.write, "check_recording", lambda *_, **__: None)
        write_recording(path, recording)


def run(line: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    capsys.readouterr()
    code = torchsph(line.split()) or 0
    said = capsys.readouterr()
    return code, " ".join((said.out + said.err).split())


@pytest.mark.parametrize("name", ODD)
def test_what_is_odd_is_told_or_refused(
    sound: Recording,
    tmp_path: Path,
    name: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    case = ODD[name]
    odd, file, target = case.change(sound), tmp_path / "odd.h5", tmp_path / "converted.h5"
    unchecked(file, odd, monkeypatch)
    for line in (f"info {file}", f"convert {file} --out {target}"):
        code, said = run(line, capsys)
        assert code == (2 if case.severe else 0), said
        for words in (case.dataset, case.rule, case.cure):
            assert words in said
        assert target.exists() == (line.startswith("convert") and not case.severe)
        target.unlink(missing_ok=True)
        code, said = run(f"{line} --strict", capsys)
        assert code == 2 and case.dataset in said and ".h5" in said
        assert not target.exists()
    with pytest.raises(RecordingError, match=case.dataset):
        write_recording(target, odd, strict=True)
    if case.severe:
        with pytest.raises(RecordingError, match=case.dataset):
            write_recording(target, odd)
    assert not target.exists()


def test_what_is_sound_raises_no_word(sound: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    closed = replace(sound, wall=replace(sound.wall, region=np.zeros_like(sound.wall.region)))
    write_recording(tmp_path / "sound.h5", closed, strict=True)
    for line in ("info", "info --strict", f"convert --out {tmp_path}/other.h5 --strict"):
        command, *rest = line.split()
        code, said = run(f"{command} {tmp_path}/sound.h5 {' '.join(rest)}", capsys)
        assert code == 0 and "warning" not in said


def _packed(file: h5py.File, scale: float | None) -> None:
    counts = np.rint(file["velocity"][()] / 1e-3).astype(np.int16)
    del file["velocity"]
    file["velocity"] = counts
    if scale is not None:
        file["velocity"].attrs.update(scale_factor=scale, add_offset=0.0, units="mm/s" if scale == 1 else "m/s")


FILES: dict[str, tuple[Callable[[h5py.File], None], str]] = {
    "counts without a scale": (lambda file: _packed(file, None), "/velocity: holds integers without .* scale_factor"),
    "a scale in words": (
        lambda file: (_packed(file, 1e-3), file["velocity"].attrs.update(scale_factor="0.001")),
        "/velocity: its attribute scale_factor must be one number",
    ),
    "a unit that is none": (
        lambda file: file["velocity"].attrs.update(units="furlongs"),
        "/velocity: its attribute units: 'furlongs' is no unit of velocity",
    ),
    "a density in words": (lambda file: file.attrs.update(rho="1060"), "rho: must be one number, not '1060'"),
    "a period in words": (lambda file: file.attrs.update(period="0.8 s"), "period: must be one number"),
    "an origin in words": (lambda file: file["grid"].attrs.update(origin="0,0,0"), "/grid: .*origin must be 3 numbers"),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("command", ["info", "convert"])
def test_files_that_say_it_in_words_or_counts_are_refused(
    sound: Recording, tmp_path: Path, name: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    import re

    change, message = FILES[name]
    write_recording(tmp_path / "f.h5", sound)
    with h5py.File(tmp_path / "f.h5", "r+") as file:
        change(file)
    more = f"--out {tmp_path}/m.h5" if command == "convert" else ""
    code, said = run(f"{command} {tmp_path}/f.h5 {more}", capsys)
    assert code == 2 and re.search(rf"f\.h5: (attribute )?{message}", said), said
    assert not (tmp_path / "m.h5").exists()


@pytest.mark.parametrize("scale", [1e-3, 1.0])
def test_packed_counts_are_unpacked_on_the_way(
    sound: Recording, tmp_path: Path, scale: float, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(tmp_path / "f.h5", sound)
    with h5py.File(tmp_path / "f.h5", "r+") as file:
        _packed(file, scale)
    code, said = run(f"convert {tmp_path}/f.h5 --out {tmp_path}/m.h5 --strict", capsys)
    assert code == 0, said
    np.testing.assert_allclose(read_recording(tmp_path / "m.h5").velocity, sound.velocity, atol=6e-4)
