"""The recording file: every rule broken once, round trips, nothing outside the file, nothing half-written."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import geometry
from geometry import Recording, RecordingError, read_recording, write_recording


def _flow(points: np.ndarray, t: float) -> np.ndarray:
    return 0.1 * np.cos(100 * points + t)


@pytest.fixture(name="full")
def _full(box_recording: Callable[..., Recording]) -> Recording:
    """A small recording that has every dataset of the format."""
    plain = box_recording(_flow, nodes=4)
    frames, shape = plain.frames, plain.grid.shape
    draw = np.random.default_rng(0)
    beam = draw.normal(size=(3, *shape))
    extra = {
        "weight": draw.uniform(size=(frames, *shape)),
        "sigma": draw.uniform(size=(frames, 3, *shape)),
        "uncovered": [0, 1, 2],
        "beam": beam / np.linalg.norm(beam, axis=0),
        "nyquist": [0.3, 0.3, 0.4],
        "pressure": draw.normal(size=(frames, *shape)),
        "valve_intervals": [[1, 0.0, 0.005], [2, 0.01, 0.02]],
        "valve_open": [[1, 0], [0, 1], [0, 1]],
        "volume": [1e-6, 1e-6, 1e-6],
        "flux_mitral": [0.0, 1e-6, 0.0],
        "flux_aortic": [0.0, 0.0, -1e-6],
        "valve_leak": [[1, 0.05]],
        "fluxes": (
            geometry.OpeningFlux(1, [1e-6, 2e-6, 0.0], [1e-7, 2e-7, 1e-7]),
            geometry.OpeningFlux(12, [0.0, -1e-6, 0.0]),
        ),
    }
    wanted = {name: getattr(plain, name) for name in ("time", "grid", "velocity", "mask", "wall", "rho", "mu")}
    wanted["wall"] = replace(plain.wall, sigma=draw.uniform(0, 1e-3, plain.wall.vertices.shape[:2]))
    return Recording(**wanted, **extra, period=0.0, description="a box")


@pytest.fixture(name="path")
def _path(full: Recording, tmp_path: Path) -> Path:
    path = tmp_path / "box.h5"
    write_recording(path, full)
    return path


def _assert_equal(one: Recording, other: Recording) -> None:
    assert one.grid == other.grid and one.arrays().keys() == other.arrays().keys()
    for dataset, values in one.arrays().items():
        assert values.dtype == other.arrays()[dataset].dtype
        np.testing.assert_array_equal(values, other.arrays()[dataset], err_msg=dataset)
    for name in ("rho", "mu", "period", "description"):
        assert getattr(one, name) == getattr(other, name)


def test_round_trip_keeps_every_array_and_number(full: Recording, path: Path) -> None:
    _assert_equal(full, read_recording(path))


@pytest.mark.parametrize("options", [{}, {"compression": "lzf"}, {"compression": "gzip", "chunks": (1, 1, 2, 3, 3)}])
def test_any_chunking_and_the_named_compressions_are_read(path: Path, full: Recording, options: dict) -> None:
    with h5py.File(path, "r+") as file:
        values = file["velocity"][()]
        del file["velocity"]
        file.create_dataset("velocity", data=values, **options)
    _assert_equal(full, read_recording(path))


def test_plane_recordings_have_two_components_and_polylines(box_recording: Callable, tmp_path: Path) -> None:
    plane = box_recording(_flow, dimension=2)
    write_recording(tmp_path / "plane.h5", plane)
    back = read_recording(tmp_path / "plane.h5")
    _assert_equal(plane, back)
    assert back.dimension == 2 and back.velocity.shape[1] == 2 and back.wall.at(0).volume == pytest.approx(1e-4)


def test_static_mask_and_wall_serve_every_frame(path: Path, full: Recording) -> None:
    with h5py.File(path, "r+") as file:
        mask, vertices = file["mask"][0], file["wall/vertices"][0]
        del file["mask"], file["wall/vertices"], file["wall/velocity"]
        file["mask"], file["wall/vertices"] = mask, vertices
    back = read_recording(path)
    assert back.mask.shape == full.mask.shape and not back.wall.moves
    assert back.wall.at(2).volume == pytest.approx(full.wall.at(0).volume)


def test_attributes_of_one_element_and_byte_strings_are_read(path: Path, full: Recording) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = np.bytes_("recording")
        file.attrs["description"] = np.array([b"a box"])
        file.attrs["format_version"], file.attrs["rho"] = np.array([1]), np.array([full.rho])
    _assert_equal(full, read_recording(path))


def test_nan_is_allowed_where_the_weight_is_zero_and_outside_the_mask(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        weight, velocity, mask = file["weight"][()], file["velocity"][()], file["mask"][()].astype(bool)
        weight[0, 2, 2, 2] = 0
        velocity[0, :, 2, 2, 2] = np.nan
        velocity[:, :, ~mask[0]] = np.nan
        file["weight"][...], file["velocity"][...] = weight, velocity
    back = read_recording(path)
    assert np.isnan(back.velocity[0, :, 2, 2, 2]).all()
    assert (np.moveaxis(back.velocity, 1, -1)[~back.mask] == 0).all()


def _set(dataset: str, where: tuple, value: float) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        values = file[dataset][()]
        values[where] = value
        file[dataset][...] = values

    return change


def _scale(dataset: str, factor: float) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file[dataset][...] = file[dataset][()] * factor

    return change


def _replace(dataset: str, make: Callable[[np.ndarray], np.ndarray]) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        values = make(file[dataset][()])
        del file[dataset]
        file[dataset] = values

    return change


def _attribute(group: str, name: str, value: object) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        if value is None:
            del file[group].attrs[name]
        else:
            file[group].attrs[name] = value

    return change


def _remove(dataset: str) -> Callable[[h5py.File], None]:
    return lambda file: file.__delitem__(dataset)


INSIDE = (0, 0, 2, 2, 2)


def _many_periods(file: h5py.File) -> None:
    file.attrs["period"], file["time"][2] = 1e-3, 11.0


def _in_millimetres(file: h5py.File) -> None:
    for name in ("origin", "spacing"):
        file["grid"].attrs[name] *= 1e3
    file["wall/vertices"][...] *= 1e3


def _unused_vertex(file: h5py.File) -> None:
    del file["wall/sigma"]
    for name, value in (("vertices", 0.5), ("velocity", 0.0)):
        values = file[f"wall/{name}"][()]
        del file[f"wall/{name}"]
        file[f"wall/{name}"] = np.concatenate([values, np.full_like(values[:, :1], value)], axis=1)


RULES: list[tuple[str, Callable[[h5py.File], None], str]] = [
    *[
        (f"missing {name}", _remove(name), f"/{name}: is required but missing")
        for name in ("time", "velocity", "mask", "wall/vertices", "wall/faces", "wall/region", "grid")
    ],
    ("velocity rank", _replace("velocity", lambda v: v[0]), "/velocity: must have 5 axes"),
    ("velocity components", _replace("velocity", lambda v: v[:, :2]), "/velocity: has the shape"),
    ("frames disagree", _replace("time", lambda v: v[:2]), "/velocity: has the shape"),
    ("no frame", _replace("time", lambda v: v[:0]), "/time: must be"),
    ("mask shape", _replace("mask", lambda v: v[:, 1:]), "/mask: has the shape"),
    ("weight shape", _replace("weight", lambda v: v[:1]), "/weight: has the shape"),
    ("sigma shape", _replace("sigma", lambda v: v[:, 0]), "/sigma: has the shape"),
    ("beam shape", _replace("beam", lambda v: v[:2]), "/beam: has the shape"),
    ("nyquist shape", _replace("nyquist", lambda v: np.repeat(v[:, None], 3, 1)), "/nyquist: has the shape"),
    ("nyquist 0", _set("nyquist", (1,), 0.0), "/nyquist: is the speed at which a measurement wraps"),
    ("nyquist NaN", _set("nyquist", (1,), np.nan), "/nyquist: is the speed"),
    ("uncovered shape", _replace("uncovered", lambda v: v[:1]), "/uncovered: has the shape"),
    ("pressure shape", _replace("pressure", lambda v: v[0]), "/pressure: has the shape"),
    ("vertices shape", _replace("wall/vertices", lambda v: v[:2]), "/wall/vertices: has the shape"),
    ("faces shape", _replace("wall/faces", lambda v: v[:, :2]), "/wall/faces: has the shape"),
    ("region length", _replace("wall/region", lambda v: v[1:]), "/wall/region: has the shape"),
    ("wall velocity shape", _replace("wall/velocity", lambda v: v[0]), "/wall/velocity: has the shape"),
    ("intervals shape", _replace("valve/intervals", lambda v: v[:, :2]), "/valve/intervals: has the shape"),
    ("valve_open shape", _replace("valve_open", lambda v: v[:, :1]), "/valve_open: has the shape"),
    ("volume shape", _replace("volume", lambda v: v[:2]), "/volume: has the shape"),
    ("flux shape", _replace("flux/mitral", lambda v: v[:2]), "/flux/mitral: has the shape"),
    ("region flux shape", _replace("flux/region_1", lambda v: v[:2]), "/flux/region_1: has the shape"),
    ("region flux NaN", _set("flux/region_1", (0,), np.nan), "/flux/region_1: must be finite"),
    ("region flux error", _set("flux/region_1_sigma", (0,), -1.0), "/flux/region_1_sigma: .*must not be negative"),
    ("error alone", _remove("flux/region_1"), "/flux/region_1_sigma: is the deviation of /flux/region_1, .*missing"),
    ("wall error shape", _replace("wall/sigma", lambda v: v[:, :2]), "/wall/sigma: has the shape"),
    ("wall error negative", _set("wall/sigma", (0, 0), -1.0), "/wall/sigma: is the standard deviation"),
    ("leak shape", _replace("valve/leak", lambda v: v[0]), "/valve/leak: has the shape"),
    ("leak of the wall", _set("valve/leak", (0, 0), 0.0), "/valve/leak: its first column must hold region labels"),
    ("all of it leaks", _set("valve/leak", (0, 1), 1.0), "/valve/leak: must hold the part of a shut valve's area"),
    ("velocity NaN", _set("velocity", INSIDE, np.nan), "/velocity: must be finite inside the mask"),
    ("sigma inf", _set("sigma", INSIDE, np.inf), "/sigma: must be finite inside the mask"),
    ("sigma negative", _set("sigma", INSIDE, -1.0), "/sigma: .*must not be negative"),
    ("beam NaN", _set("beam", INSIDE[1:], np.nan), "/beam: must be finite inside the mask"),
    ("beam length", _scale("beam", 2.0), "/beam: must hold unit vectors"),
    ("pressure NaN", _set("pressure", (0, 2, 2, 2), np.nan), "/pressure: must be finite inside the mask"),
    ("time falls", _replace("time", lambda v: v[::-1]), "/time: must increase strictly"),
    ("time repeats", _set("time", (1,), 0.0), "/time: must increase strictly"),
    ("time NaN", _set("time", (1,), np.nan), "/time: must be finite"),
    ("weight above 1", _set("weight", (0, 0, 0, 0), 1.5), r"/weight: must lie in \[0, 1\], but is 1.5"),
    ("weight below 0", _set("weight", (0, 0, 0, 0), -0.5), r"/weight: must lie in \[0, 1\]"),
    ("weight NaN", _set("weight", (0, 2, 2, 2), np.nan), r"/weight: must lie in \[0, 1\]"),
    ("open surface", _replace("wall/faces", lambda v: v[[0, *range(2, 12), 0]][:, [0, 1, 2]]), "not closed"),
    ("one face turned", _set("wall/faces", (0, slice(None)), [0, 3, 2]), "opposite senses"),
    ("inside out", _replace("wall/faces", lambda v: v[:, ::-1]), "/wall/faces: .*inside out"),
    (
        "inside out later",
        _set("wall/vertices", (2, slice(None), 2), np.linspace(0.01, 0.0, 8).round(2)),
        "/wall/vertices: .*inside out at frame 2",
    ),
    ("face index", _set("wall/faces", (0, 0), 99), "/wall/faces: .*number vertices 0 to 7"),
    ("vertices NaN", _set("wall/vertices", (0, 0, 0), np.nan), "/wall/vertices: must be finite"),
    ("wall velocity NaN", _set("wall/velocity", (0, 0, 0), np.nan), "/wall/velocity: must be finite"),
    ("spacing 0", _attribute("grid", "spacing", [0.001, 0.0, 0.001]), "/grid: spacing must be positive"),
    ("spacing < 0", _attribute("grid", "spacing", [0.001, -1.0, 0.001]), "/grid: spacing must be positive"),
    ("origin missing", _attribute("grid", "origin", None), "/grid: its attribute origin is required"),
    (
        "origin of 2 numbers",
        _attribute("grid", "origin", [0.0, 0.0]),
        "/grid: its attribute origin must be 3",
    ),
    ("speed in mm/s", _scale("velocity", 1000.0), "/velocity: reaches .*above 20 m/s"),
    ("wall in mm/s", _set("wall/velocity", (0, 0, 0), 300.0), "/wall/velocity: reaches 300"),
    ("grid beside the wall", _attribute("grid", "origin", [1.0, 0.0, 0.0]), "/grid: .*does not overlap"),
    ("format", _attribute("/", "format", "movie"), 'attribute format: must be "recording"'),
    ("no format", _attribute("/", "format", None), 'attribute format: must be "recording"'),
    ("version", _attribute("/", "format_version", 2), "attribute format_version: must be 1"),
    ("dimension", _attribute("/", "dimension", 4), "attribute dimension: must be 2 or 3"),
    ("no version", _attribute("/", "format_version", None), "attribute format_version: is required"),
    ("no rho", _attribute("/", "rho", None), "attribute rho: is required"),
    ("rho 0", _attribute("/", "rho", 0.0), "attribute rho: must be a positive density"),
    ("rho 1e300", _attribute("/", "rho", 1e300), "attribute rho: must be a positive density"),
    ("mu 1e300", _attribute("/", "mu", 1e300), "attribute mu: must be finite and not negative"),
    ("period 1e-12", _attribute("/", "period", 1e-12), "attribute period: is 1e-12 s, shorter than every beat"),
    ("period 1e300", _attribute("/", "period", 1e300), "attribute period: must be finite"),
    ("many periods", _many_periods, "attribute period: is 0.001 s, of which the frames span more"),
    ("time 1e300", _set("time", (2,), 1e300), "/time: reaches 1e[+]300 s"),
    ("spacing 1e300", _attribute("grid", "spacing", [1e300] * 3), "/grid: spacing must lie between"),
    ("spacing 1e-30", _attribute("grid", "spacing", [0.001, 1e-30, 0.001]), "/grid: spacing must lie between"),
    ("origin 1e300", _attribute("grid", "origin", [1e300, 0.0, 0.0]), "/grid: the box .* lies farther than"),
    ("lengths in mm", _in_millimetres, "/grid: is 12.5 m large, so it is probably in mm"),
    ("vertices 1e300", _set("wall/vertices", (0, 0, 0), 1e300), "/wall/vertices: reaches 1e[+]300 m"),
    ("unused vertex", _unused_vertex, "/wall/vertices: vertices that no face uses lie up to"),
    ("100,000 rows", _replace("valve/intervals", lambda v: np.tile(v[:1], (100_000, 1))), "holds 100000 rows"),
    ("valve 1e300", _set("valve/intervals", (0, 1), -1e300), "/valve/intervals: times must lie within"),
    ("mu negative", _attribute("/", "mu", -1.0), "attribute mu: must be finite and not negative"),
    ("mu text", _attribute("/", "mu", "water"), "attribute mu: must be one number"),
    ("period NaN", _attribute("/", "period", np.nan), "attribute period: must be finite"),
    ("mask of 255", _replace("mask", lambda v: v * 255), "/mask: must hold 0 and 1 only"),
    ("faces of floats", _replace("wall/faces", lambda v: v + 0.5), "/wall/faces: must hold integers"),
    ("text", _replace("volume", lambda v: np.array([b"a"] * 3)), "/volume: must be numbers"),
    ("valve state 2", _set("valve_open", (0, 0), 2), "/valve_open: must hold 0"),
    ("valve closes first", _set("valve/intervals", (0, 2), -1.0), "/valve/intervals: .*close after it opens"),
    ("valve of no region", _set("valve/intervals", (0, 0), 0.5), "/valve/intervals: .*region labels"),
    ("valve NaN", _set("valve/intervals", (0, 1), np.nan), "/valve/intervals: must be finite"),
    ("volume NaN", _set("volume", (0,), np.nan), "/volume: must be finite"),
    ("uncovered negative", _set("uncovered", (0,), -1), "/uncovered: .*must not be negative"),
]


@pytest.mark.parametrize(("change", "message"), [rule[1:] for rule in RULES], ids=[rule[0] for rule in RULES])
def test_each_rule_broken_once_is_named(path: Path, change: Callable, message: str) -> None:
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(RecordingError, match=message) as caught:
        read_recording(path)
    assert str(caught.value).startswith(str(path))


def test_a_group_in_the_place_of_a_dataset_is_refused(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["volume"]
        file.create_group("volume")
    with pytest.raises(RecordingError, match="/volume: must be a dataset"):
        read_recording(path)


def test_links_inside_the_file_are_followed_and_others_refused(path: Path, full: Recording, tmp_path: Path) -> None:
    other = tmp_path / "other.h5"
    write_recording(other, full)
    with h5py.File(path, "r+") as file:
        file.move("velocity", "elsewhere")
        file["velocity"] = h5py.SoftLink("/elsewhere")
    _assert_equal(full, read_recording(path))
    for link in (h5py.ExternalLink(str(other), "/velocity"), h5py.ExternalLink(str(other), "/")):
        with h5py.File(path, "r+") as file:
            if "elsewhere" in file:
                del file["elsewhere"]
            file["elsewhere"] = link
        with pytest.raises(RecordingError, match="/velocity: is a link to data in another file"):
            read_recording(path)


def test_a_circle_of_links_ends(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["velocity"]
        file["velocity"] = h5py.SoftLink("/velocity")
    with pytest.raises(RecordingError, match="/velocity: is a circle of soft links"):
        read_recording(path)


def test_external_storage_and_virtual_datasets_are_refused(path: Path, tmp_path: Path) -> None:
    with h5py.File(path, "r+") as file:
        shape = file["velocity"].shape
        del file["velocity"]
        file.create_dataset("velocity", shape, "f4", external=[(str(tmp_path / "raw.bin"), 0, h5py.h5f.UNLIMITED)])
    with pytest.raises(RecordingError, match="/velocity: keeps its data in another file"):
        read_recording(path)
    with h5py.File(path, "r+") as file:
        del file["velocity"]
        layout = h5py.VirtualLayout(shape, "f4")
        layout[...] = h5py.VirtualSource(str(tmp_path / "raw.h5"), "velocity", shape)
        file.create_virtual_dataset("velocity", layout)
    with pytest.raises(RecordingError, match="/velocity: keeps its data in another file"):
        read_recording(path)


def test_other_filters_are_refused_before_they_load_code(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        values = file["velocity"][()]
        del file["velocity"]
        file.create_dataset("velocity", data=values, chunks=True, scaleoffset=3)
    with pytest.raises(RecordingError, match="/velocity: is stored through .*use gzip, lzf or no"):
        read_recording(path)


def test_files_that_are_missing_or_no_hdf5_are_named(tmp_path: Path, path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere.h5"):
        read_recording(tmp_path / "nowhere.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(RecordingError, match=r"text.h5: file: is not a readable HDF5 file"):
        read_recording(tmp_path / "text.h5")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RecordingError, match="box.h5: file: is"):
        read_recording(path)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    path: Path, full: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = path.read_bytes()

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_recording(path, full)
    assert path.read_bytes() == before and os.listdir(path.parent) == [path.name]


def test_a_recording_that_breaks_a_rule_is_not_written(full: Recording, tmp_path: Path) -> None:
    fast = full.with_velocity(1000 * full.velocity)
    with pytest.raises(RecordingError, match="new.h5: /velocity: reaches"):
        write_recording(tmp_path / "new.h5", fast)
    assert not os.listdir(tmp_path)
    with pytest.raises(FileNotFoundError, match="there is no directory"):
        write_recording(tmp_path / "no" / "new.h5", full)


def test_written_files_get_the_usual_permissions(path: Path, tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("x")
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_velocity_outside_the_mask_is_written_as_zero(full: Recording, tmp_path: Path) -> None:
    noisy = full.with_velocity(np.ones_like(full.velocity))
    write_recording(tmp_path / "noisy.h5", noisy)
    with h5py.File(tmp_path / "noisy.h5") as file:
        velocity = np.moveaxis(file["velocity"][()], 1, -1)
    assert (velocity[~full.mask] == 0).all() and (velocity[full.mask] == 1).all()


def test_select_takes_frames_of_everything(full: Recording) -> None:
    for frames in (slice(1, None), [1, 2], np.array([False, True, True])):
        part = full.select(frames)
        assert part.frames == 2 and part.time.tolist() == full.time[1:].tolist()
        for dataset in (
            "/velocity",
            "/mask",
            "/weight",
            "/sigma",
            "/wall/vertices",
            "/valve_open",
            "/volume",
            "/wall/sigma",
            "/flux/region_1_sigma",
            "/flux/region_12",
        ):
            np.testing.assert_array_equal(part.arrays()[dataset], full.arrays()[dataset][1:])
        np.testing.assert_array_equal(part.beam, full.beam)
        np.testing.assert_array_equal(part.valve_intervals, full.valve_intervals)


def test_with_velocity_drops_what_described_the_old_velocity(full: Recording) -> None:
    other = full.with_velocity(2 * full.velocity, uncovered=[1, 1, 1], description="analysis")
    assert other.description == "analysis" and other.uncovered.tolist() == [1, 1, 1]
    for name in ("weight", "sigma", "beam", "nyquist", "pressure", "flux_mitral", "flux_aortic"):
        assert getattr(other, name) is None
    assert other.fluxes == ()
    np.testing.assert_array_equal(other.volume, full.volume)
    with pytest.raises(RecordingError, match="/velocity: has the shape"):
        full.with_velocity(full.velocity[:1])


def test_files_without_measured_fluxes_have_none_and_other_names_under_flux_are_left_alone(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        for name in ("region_1", "region_1_sigma", "region_12"):
            del file["flux"][name]
        file["flux/region_0"], file["flux/region_999"], file["flux/regional"] = [1.0], [1.0], [1.0]
        del file["wall/sigma"], file["valve/leak"]
    plain = read_recording(path)
    assert plain.fluxes == () and plain.wall.sigma is None and plain.valve_leak is None
    assert set(plain.arrays()) & {"/flux/region_0", "/flux/region_999", "/valve/leak", "/wall/sigma"} == set()


def test_a_flux_without_a_deviation_is_off_by_a_tenth_of_its_rms(full: Recording) -> None:
    np.testing.assert_allclose(full.fluxes[1].deviation, 0.1 * 1e-6 / np.sqrt(3))
    np.testing.assert_array_equal(full.fluxes[0].deviation, full.fluxes[0].sigma)
    with pytest.raises(RecordingError, match="/flux/region_0: names no opening"):
        geometry.OpeningFlux(0, [1.0])
    with pytest.raises(RecordingError, match="/flux/region_1: is given twice"):
        replace(full, fluxes=(full.fluxes[0], full.fluxes[0]))


def test_valve_changes_are_derived_midway_between_frames(box_recording: Callable) -> None:
    states = [[1, 0], [1, 0], [0, 1], [0, 1], [1, 0]]
    recording = box_recording(_flow, times=(0.0, 0.01, 0.02, 0.04, 0.06), valve_open=states)
    derived = recording.valve_intervals_or_derived()
    expected = [[1, -np.inf, 0.015], [1, 0.05, np.inf], [2, 0.015, 0.05]]
    np.testing.assert_allclose(derived, expected)
    assert box_recording(_flow).valve_intervals_or_derived().shape == (0, 3)
    given = box_recording(_flow, valve_open=[[0, 0]] * 3, valve_intervals=[[1, 0.0, 0.01]])
    np.testing.assert_array_equal(given.valve_intervals_or_derived(), [[1, 0.0, 0.01]])


def test_errors_survive_pickling() -> None:
    error = pickle.loads(pickle.dumps(RecordingError("a.h5", "/time", "must increase")))
    assert str(error) == "a.h5: /time: must increase" and error.dataset == "/time"


def test_public_names_are_all_there() -> None:
    for name in geometry.__all__:
        assert getattr(geometry, name) is not None
