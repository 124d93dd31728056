"""What cannot be meant is found, with its numbers; what is sound is left alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import geometry
from geometry import Grid, Recording, RecordingError, Surface, Ventricle, Wall, read_recording, write_recording
from geometry.recordings.checks import findings
from geometry.recordings.field_checks import best_order
from geometry.recordings.units import factor

TIMES = tuple(np.arange(6) * 0.01)


def straining(points: np.ndarray, time: float) -> np.ndarray:
    """A steady flow without divergence whose components differ: a strain and a rotation."""
    x, y, z = (points - 0.005).T
    return np.stack([40 * x - 10 * y, 10 * x + 20 * y, -60 * z + 5 * x], axis=1) + 0.05


@pytest.fixture(name="sound")
def _sound(box_recording: Callable[..., Recording]) -> Recording:
    return box_recording(straining, times=TIMES, wall_velocity=lambda vertices: 0.01 * vertices)


def scaled(recording: Recording, length: float = 1.0, time: float = 1.0) -> Recording:
    grid = Grid(
        *(tuple(length * np.array(part)) for part in (recording.grid.origin, recording.grid.spacing)),
        recording.grid.shape,
    )
    wall = Wall(recording.wall.vertices * length, recording.wall.faces, recording.wall.region)
    return replace(recording, grid=grid, wall=wall, time=recording.time * time, period=recording.period * time)


def said(recording: Recording) -> dict[str, str]:
    """What is told of each dataset."""
    told: dict[str, str] = {}
    for finding in findings(recording):
        told[finding.dataset] = f"{told.get(finding.dataset, '')} {finding.rule}".strip()
    return told


def test_sound_recordings_raise_no_finding(sound: Recording) -> None:
    assert findings(sound) == []
    beat = Ventricle().recording(np.linspace(0, 0.2, 5), grid_spacing=4e-3, wall_spacing=4e-3)
    assert [finding for finding in findings(beat) if finding.dataset != "/velocity"] == []


@pytest.mark.parametrize(
    ("length", "time", "dataset", "message"),
    [
        (1e3, 1, "/grid", "is 11.25 m large, so it is probably in mm"),
        (100, 1, "/grid", "is 1.125 m large, so it is probably in mm or cm"),
        (1, 1e3, "/time", "frames are 10 s apart, so they are probably in ms"),
    ],
)
def test_units_are_told_by_size_and_refused(
    sound: Recording, tmp_path: Path, length: float, time: float, dataset: str, message: str
) -> None:
    with pytest.raises(RecordingError, match=f"x.h5: {dataset}: {message}"):
        write_recording(tmp_path / "x.h5", scaled(sound, length, time))
    assert not list(tmp_path.iterdir())


def test_a_file_whose_lengths_are_in_mm_is_refused_when_read(sound: Recording, tmp_path: Path) -> None:
    write_recording(tmp_path / "mm.h5", sound)
    with h5py.File(tmp_path / "mm.h5", "r+") as file:
        for name in ("origin", "spacing"):
            file["grid"].attrs[name] *= 1e3
        file["wall/vertices"][...] *= 1e3
    with pytest.raises(RecordingError, match="mm.h5: /grid: is 11.25 m large, so it is probably in mm"):
        read_recording(tmp_path / "mm.h5")


def test_a_beat_of_minutes_is_refused(sound: Recording) -> None:
    (finding,) = findings(replace(sound, period=450.0))
    assert finding.severe and "450 s" in finding.rule and "ms" in finding.rule


def test_errors_of_zero_and_beyond_sense_are_refused(sound: Recording, tmp_path: Path) -> None:
    sigma = np.full(sound.velocity.shape, 0.1, np.float32)
    assert findings(replace(sound, sigma=sigma)) == []
    zero = sigma.copy()
    zero[0, 1, 4, 4, 4] = 0
    with pytest.raises(RecordingError, match=r"/sigma: is 0 for 1 of 9216 measured values"):
        write_recording(tmp_path / "x.h5", replace(sound, sigma=zero))
    analysis = replace(sound, sigma=zero, uncovered=np.zeros(len(TIMES), int))
    assert findings(analysis) == []  # an analysis may know a value exactly; no filter reads its errors
    with pytest.raises(RecordingError, match=r"/sigma: reaches 1e\+19 m/s"):
        write_recording(tmp_path / "x.h5", replace(sound, sigma=sigma * 1e20))
    assert not next(iter(findings(replace(sound, sigma=sigma * 500)))).severe


@pytest.mark.parametrize(
    ("order", "signs", "words"),
    [((2, 1, 0), (1, 1, 1), "z,y,x"), ((1, 0, 2), (1, 1, 1), "y,x,z"), ((0, 1, 2), (1, -1, 1), "x,-y,z")],
)
def test_swapped_and_flipped_components_are_told(sound: Recording, order: tuple, signs: tuple, words: str) -> None:
    shape = (1, 3, 1, 1, 1)
    wrong = replace(sound, velocity=sound.velocity[:, list(order)] * np.array(signs).reshape(shape))
    assert words in said(wrong)["/velocity"]
    name, claimed, best = best_order(wrong)
    assert name == words and best < 1e-5 < 0.3 < claimed


def test_noise_does_not_look_like_another_order(sound: Recording) -> None:
    draw = np.random.default_rng(0)
    noise = np.where(sound.mask[:, None], draw.normal(0, 0.3, sound.velocity.shape), 0)
    assert findings(replace(sound, velocity=sound.velocity + noise)) == []
    assert findings(replace(sound, velocity=noise)) == []


def test_a_mask_beside_the_wall_is_told_or_refused(sound: Recording, tmp_path: Path) -> None:
    moved = replace(sound, wall=Wall(sound.wall.vertices + [0.0025, 0, 0], sound.wall.faces, sound.wall.region))
    assert "25 % of the nodes in the mask lie outside the wall" in said(moved)["/mask"]
    write_recording(tmp_path / "x.h5", moved)
    with pytest.raises(RecordingError, match="/mask: 25 %"):
        write_recording(tmp_path / "x.h5", moved, strict=True)
    far = replace(sound, wall=Wall(sound.wall.vertices + [0.008, 0, 0], sound.wall.faces, sound.wall.region))
    with pytest.raises(RecordingError, match="finite thickness"):
        write_recording(tmp_path / "x.h5", far)
    few = replace(sound, mask=sound.mask & (np.arange(10) < 4))
    assert "leaves out 62.5 % of the nodes inside the wall" in said(few)["/mask"]


def test_bodies_of_the_wall_must_not_overlap(sound: Recording) -> None:
    wall = sound.wall.at(0)
    other = Surface(wall.vertices + 0.004, wall.faces)
    both = Wall(
        np.concatenate([wall.vertices, other.vertices]),
        np.concatenate([wall.faces, other.faces + len(wall.vertices)]),
        np.zeros(2 * len(wall.faces), np.uint8),
    )
    assert "its bodies overlap" in said(replace(sound, wall=both))["/wall/faces"]


def test_volumes_and_fluxes_are_held_against_the_wall(sound: Recording) -> None:
    enclosed = np.array([sound.wall.at(frame).volume for frame in range(sound.frames)])
    rate = np.gradient(enclosed, sound.time)
    fine = replace(sound, volume=enclosed, flux_mitral=rate, flux_aortic=np.zeros_like(rate))
    assert findings(fine) == []
    assert "where the wall encloses 1e-06 m3" in said(replace(fine, volume=1e6 * enclosed))["/volume"]
    assert "by 2 of it" in said(replace(fine, flux_mitral=-rate))["/flux/mitral"]


def test_a_wall_that_flickers_is_told(sound: Recording) -> None:
    draw = np.random.default_rng(0)
    vertices = sound.wall.vertices + draw.normal(0, 2e-4, sound.wall.vertices.shape)
    rough = replace(sound, wall=Wall(vertices, sound.wall.faces, sound.wall.region))
    assert "flickers" in said(rough)["/wall/vertices"]
    stated = replace(sound, wall=replace(sound.wall, velocity=1e3 * sound.wall.velocity))
    assert "is not how the vertices move" in said(stated)["/wall/velocity"]


def test_valves_that_open_without_frames_or_faces_are_told(sound: Recording) -> None:
    fine = replace(sound, valve_intervals=np.array([[1, 0.01, 0.03]]))
    assert findings(fine) == []
    late = replace(sound, valve_intervals=np.array([[1, 10.0, 30.0]]))
    assert "open from 10 to 30 s, far from every frame" in said(late)["/valve/intervals"]
    beating = replace(sound, period=0.8, valve_intervals=np.array([[1, 0.0, 450.0]]))
    assert "longer than the period" in said(beating)["/valve/intervals"]
    other = replace(sound, valve_intervals=np.array([[3, 0.0, 0.03]]))
    assert "region 3, of which the wall has no face" in said(other)["/valve/intervals"]


def test_a_wall_of_openings_alone_is_told(sound: Recording) -> None:
    every = replace(sound, wall=replace(sound.wall, region=np.ones_like(sound.wall.region)))
    (told,) = [one for one in findings(every) if one.dataset == "/wall/region"]
    assert "every face is an opening (regions 1)" in str(told) and "give 0 to the faces of the wall itself" in str(told)


def test_fluxes_and_volumes_that_overflow_are_refused(sound: Recording) -> None:
    for name, dataset in (("flux_mitral", "/flux/mitral"), ("volume", "/volume")):
        with pytest.raises(RecordingError, match=f"{dataset}: reaches 1.7e[+]308 m3.*ml times 1e-6"):
            replace(sound, **{name: np.full(sound.frames, 1.7e308)}).check()


def test_wrapped_speeds_are_told(box_recording: Callable[..., Recording]) -> None:
    def fast(points: np.ndarray, _: float) -> np.ndarray:
        return np.stack([np.zeros(len(points)), np.zeros(len(points)), 400 * (points[:, 0] - 0.005)], axis=1)

    true = box_recording(fast, nodes=24)
    assert findings(true) == []
    wrapped = replace(true, velocity=(true.velocity + 1.2) % 2.4 - 1.2)
    assert "wrapped at +-1.15" in said(wrapped)["/velocity"]


def test_empty_and_silent_frames_are_told(sound: Recording) -> None:
    silent = sound.velocity.copy()
    silent[2] = 0
    assert "is 0 everywhere in 1 of 6 frames, the first of them 2" in said(replace(sound, velocity=silent))["/velocity"]
    few = replace(sound, weight=(np.arange(10) < 2).astype(float) * np.ones(sound.mask.shape))
    assert "only 12 %" in said(few)["/weight"]
    holes = np.where(np.arange(10) < 7, 0, sound.velocity)
    assert "is exactly 0 at 75 %" in said(replace(sound, velocity=holes))["/velocity"]


def _packed(path: Path, recording: Recording, **attributes: object) -> None:
    write_recording(path, recording)
    with h5py.File(path, "r+") as file:
        counts = np.rint(np.nan_to_num(file["velocity"][()]) / 1e-3).astype(np.int16)
        del file["velocity"]
        file["velocity"] = counts
        file["velocity"].attrs.update(attributes)


def test_packed_integers_are_unpacked_or_refused(sound: Recording, tmp_path: Path) -> None:
    _packed(tmp_path / "p.h5", sound, scale_factor=1e-3, add_offset=0.0, _FillValue=np.int16(-32768), units="m s-1")
    unpacked = read_recording(tmp_path / "p.h5")
    np.testing.assert_allclose(unpacked.velocity, sound.velocity, atol=6e-4)
    _packed(tmp_path / "p.h5", sound)
    with pytest.raises(RecordingError, match="/velocity: holds integers without an attribute scale_factor"):
        read_recording(tmp_path / "p.h5")
    _packed(tmp_path / "p.h5", sound, scale_factor=0.1, units="cm/s")
    np.testing.assert_allclose(read_recording(tmp_path / "p.h5").velocity, sound.velocity, atol=6e-4)
    _packed(tmp_path / "p.h5", sound, scale_factor="0.1")
    with pytest.raises(RecordingError, match="scale_factor must be one number"):
        read_recording(tmp_path / "p.h5")


@pytest.mark.parametrize(
    ("text", "quantity", "value"),
    [("mm", "length", 1e-3), ("ms", "time", 1e-3), ("cm/s", "velocity", 1e-2), ("mm s-1", "velocity", 1e-3)]
    + [
        ("m.s^-1", "velocity", 1.0),
        ("mm/ms", "velocity", 1.0),
        ("[m s**-1]", "velocity", 1.0),
        ("2.5e-5", "length", 2.5e-5),
    ],
)
def test_names_of_units(text: str, quantity: str, value: float) -> None:
    assert factor(text, quantity) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "quantity"), [("furlong", "length"), ("m", "velocity"), ("-1", "time"), ("s/m", "velocity")]
)
def test_unknown_units_are_refused(text: str, quantity: str) -> None:
    with pytest.raises(ValueError, match="unit"):
        factor(text, quantity)


def test_findings_are_public() -> None:
    assert geometry.findings is findings and "Finding" in geometry.__all__
