"""Exports on their way back: whole, without an option; damaged ones told by their names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from geometry import OpeningFlux, Recording, write_recording, write_surface
from geometry.formats import EXPORTS, FieldMap, FormatError, convert, export, from_xarray, write_sidecar

EXTRA = "the extra `formats` is not installed"
PACKAGES = {"vti": "vtk", "nifti": "nibabel", "nrrd": "nrrd", "netcdf": "xarray"}
PLAIN = ("grid", "rho", "mu", "period", "description", "cut")


@pytest.fixture(name="full", params=["space", "plane"])
def _full(request: pytest.FixtureRequest, recording: Recording, box_recording: Callable[..., Recording]) -> Recording:
    """Every dataset that exports may lose: valves, fluxes, quality, deviations, a limit."""
    flat = request.param == "plane"
    base = (
        box_recording(lambda points, t: points + t, dimension=2, times=(0.1, 0.12, 0.14), nodes=6)
        if flat
        else recording
    )
    draw = np.random.default_rng(3)
    wall = base.wall_for("the test")
    return replace(
        base,
        cut=flat,
        period=0.9,
        description='of "all" \u00fc',
        sigma=draw.uniform(0.01, 0.1, base.velocity.shape),
        pressure=draw.normal(size=base.mask.shape),
        pressure_sigma=np.full(base.mask.shape, 2.0),
        quality=draw.integers(0, 6, base.mask.shape),
        beam=np.stack([np.ones(base.grid.shape)] + [np.zeros(base.grid.shape)] * (base.dimension - 1)),
        nyquist=np.array([0.5, 0.6, 0.7]),
        wall=replace(wall, sigma=np.full(wall.vertices.shape[-2], 1e-4)),
        valve_intervals=np.array([[1.0, 0.1, 0.12]]),
        valve_leak=np.array([[1.0, 0.05]]),
        volume=np.array([1e-6, 2e-6, 3e-6]),
        fluxes=(OpeningFlux(1, np.array([1e-6, 0.0, -1e-6]), np.full(3, 1e-7)),),
    )


def assert_all_of_it(one: Recording, other: Recording) -> None:
    """Every bit of a recording, but that a beam at rest may come back frame by frame."""
    assert {name: getattr(one, name) for name in PLAIN} == {name: getattr(other, name) for name in PLAIN}
    first, second = one.arrays(), other.arrays()
    assert first.keys() == second.keys()
    for name, values in first.items():
        np.testing.assert_array_equal(np.broadcast_to(values, second[name].shape), second[name], name)
        assert values.dtype == second[name].dtype


@pytest.mark.parametrize("to", sorted(EXPORTS))
def test_every_export_comes_back_whole_without_an_option(full: Recording, tmp_path: Path, to: str) -> None:
    if to in PACKAGES:
        pytest.importorskip(PACKAGES[to], reason=EXTRA)
    files = export(full, tmp_path / "a.b", to)
    assert_all_of_it(full, convert([files[0]]).recording)
    single = full.select([1])
    assert_all_of_it(single, convert([export(single, tmp_path / "one", to)[0]]).recording)
    assert convert([files[0]], FieldMap(nyquist=0.3)).recording.nyquist.tolist() == [0.3] * 3
    if to == "vti":
        assert_all_of_it(full, convert([path for path in files if path.suffix == ".vti"]).recording)


@pytest.mark.parametrize("to", sorted(EXPORTS))
def test_planes_in_space_come_back_with_their_normals(recording: Recording, tmp_path: Path, to: str) -> None:
    if to in PACKAGES:
        pytest.importorskip(PACKAGES[to], reason=EXTRA)
    normal = np.stack(
        [np.zeros(recording.grid.shape), np.full(recording.grid.shape, 0.6), np.full(recording.grid.shape, 0.8)]
    )
    planes = replace(recording, normal=normal, beam=None, nyquist=None)
    files = export(planes, tmp_path / "a.b", to)
    assert_all_of_it(planes, convert([files[0]]).recording)


def test_slips_of_a_caller_are_told_where_they_enter(recording: Recording, tmp_path: Path) -> None:
    surface = recording.wall_for("the test").at(0)
    with pytest.raises(ValueError, match="write_surface: scale must be positive"):
        write_surface(tmp_path / "a.stl", surface, scale=0.0)
    for call, told in (
        (lambda: write_surface(None, surface), "write_surface: path must be text or a Path, got None"),
        (lambda: export(recording, None, "npz"), "export: path must be text or a Path"),
        (lambda: convert("m.h5"), "convert: inputs must be a sequence, each text or a Path, got 'm.h5'"),
        (lambda: from_xarray(3), "from_xarray: dataset must be an xarray Dataset, got 3"),
    ):
        with pytest.raises(TypeError, match=told):
            call()


def test_what_an_export_has_lost_is_told(full: Recording, tmp_path: Path) -> None:
    (path,) = export(full, tmp_path / "a", "npz")
    content = dict(np.load(path))
    for change, told in (
        ({"torchsph_recording": np.array("{")}, "is damaged .* export it again"),
        ({"mask": content["mask"][:2]}, "2 frames, the velocity 3"),
        ({"sigma": content["sigma"][..., :-1]}, "sigma has the shape .*, but the velocity has"),
        ({"velocity": content["velocity"][..., :-1], "sigma": content["sigma"][..., :-1]}, "mask has the shape"),
    ):
        np.savez(path, **(content | change))
        with pytest.raises(FormatError, match=rf"a\.npz: .*{told}"):
            convert([path])
    write_recording(tmp_path / "b.h5", full)
    sidecar, _ = write_sidecar(tmp_path / "b.h5")
    assert_all_of_it(full, convert([sidecar]).recording)
    (tmp_path / "b.h5").rename(tmp_path / "c.h5")
    with pytest.raises(FormatError, match=r"b\.vtkhdf: shows the values of b\.h5, which is not beside it"):
        convert([sidecar])
    with pytest.raises(FormatError, match=r"c\.h5: is a recording already, in SI units"):
        convert([tmp_path / "c.h5"], FieldMap(velocity_unit="cm/s"))


@pytest.mark.parametrize("to", sorted(EXPORTS))
def test_a_damaged_file_is_told_by_its_name_whatever_its_reader_raises(
    recording: Recording, tmp_path: Path, to: str, capfd: pytest.CaptureFixture[str]
) -> None:
    if to in PACKAGES:
        pytest.importorskip(PACKAGES[to], reason=EXTRA)
    files = export(recording, tmp_path / "a", to)
    path = files[1] if to == "vti" else files[0]
    sound = path.read_bytes()
    half = len(sound) // 2
    for damaged in (b"", b"velocity, 1, 2\n", sound[:half], sound[:100], sound[:half] + bytes(64) + sound[half + 64 :]):
        path.write_bytes(damaged)
        try:
            convert([path], FieldMap(length_unit="m", velocity_unit="m/s"))
            found = convert([files[0]]).recording
        except (FormatError, OSError) as fault:
            assert path.name in str(fault) or files[0].name in str(fault)
        else:  # what was overwritten was not read, or values of the field
            assert found.velocity.shape == recording.velocity.shape
    assert capfd.readouterr() == ("", "")  # vtk speaks in colours
