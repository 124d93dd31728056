"""Units, packed integers and axes that run backwards, as each format states them."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from geometry.formats import FieldMap, FormatError, convert

EXTRA = "the extra `formats` is not installed"
X, Y, Z = np.arange(6) * 2e-3 - 4e-3, np.arange(7) * 1.5e-3, np.arange(8) * 1e-3 + 0.01  # m
TIME = np.array([0.0, 0.02, 0.04])
STEP = 5e-5  # m/s, of the counts


def flow() -> np.ndarray:
    """(T, 3, z, y, x), m/s, without divergence."""
    z, y, x = np.meshgrid(Z, Y, X, indexing="ij")
    one = np.stack([20 * x - 9 * y + 0.1, 10 * x + 10 * y, -30 * z + 5 * x])
    return np.stack([one, 1.1 * one, 1.2 * one])


def check(path: Path, said: FieldMap | None = None, *, atol: float = 1e-6, timed: bool = True) -> None:
    recording = convert([path], said or FieldMap()).recording
    np.testing.assert_allclose(recording.grid.origin, (X[0], Y[0], Z[0]), atol=1e-9)
    np.testing.assert_allclose(recording.grid.spacing, (2e-3, 1.5e-3, 1e-3), rtol=1e-6)
    np.testing.assert_allclose(recording.velocity[:, :, 2:-2, 2:-2, 2:-2], flow()[:, :, 2:-2, 2:-2, 2:-2], atol=atol)
    if timed:
        np.testing.assert_allclose(recording.time, TIME, atol=1e-9)


@pytest.mark.parametrize("backwards", ["", "z", "xy"])
@pytest.mark.parametrize(
    ("length", "time", "speed", "per"),
    [("mm", "ms", "cm/s", (1e3, 1e3, 1e2)), ("cm", "milliseconds since 2020-01-01", "mm s-1", (1e2, 1e3, 1e3))],
)
def test_netcdf_packed_in_other_units(
    tmp_path: Path, backwards: str, length: str, time: str, speed: str, per: tuple[float, float, float]
) -> None:
    netcdf = pytest.importorskip("netCDF4", reason=EXTRA)
    places = {"x": X, "y": Y, "z": Z}
    with netcdf.Dataset(tmp_path / "f.nc", "w") as file:
        for axis, values in places.items():
            file.createDimension(axis, len(values))
            one = file.createVariable(axis, "f8", (axis,))
            one[:] = per[0] * (values[::-1] if axis in backwards else values)
            one.units = length
        file.createDimension("time", 3)
        one = file.createVariable("time", "f8", ("time",))
        one[:], one.units = per[1] * TIME, time
        order = tuple(slice(None, None, -1 if axis in backwards else 1) for axis in "zyx")
        for component, name in enumerate("uvw"):
            one = file.createVariable(name, "i2", ("time", "z", "y", "x"), fill_value=-32768)
            one.set_auto_maskandscale(False)
            one.scale_factor, one.add_offset, one.units = per[2] * STEP, per[2] * 0.5, speed
            counts = np.rint((flow()[:, component] - 0.5) / STEP).astype(np.int16)
            one[:] = counts[(slice(None), *order)]
    check(tmp_path / "f.nc", atol=0.6 * STEP)


@pytest.mark.parametrize("speed", [("cm/s", 1e2), ("mm/s", 1e3)])
def test_hdf5_packed_with_a_fill_value_and_a_unit(tmp_path: Path, speed: tuple[str, float]) -> None:
    unit, per = speed
    with h5py.File(tmp_path / "f.h5", "w") as file:
        for component, name in enumerate("uvw"):
            file[name] = np.rint((flow()[:, component] - 0.5) / STEP).astype(np.int16)
            file[name][0, 0, 0, 0] = -32768
            file[name].attrs.update(scale_factor=per * STEP, add_offset=per * 0.5, _FillValue=-32768, units=unit)
        file["t"] = 1e3 * TIME
    said = FieldMap(
        velocity=("u", "v", "w"),
        time="t",
        time_unit="ms",
        spacing=(2.0, 1.5, 1.0),
        origin=(-4.0, 0.0, 10.0),
        length_unit="mm",
    )
    check(tmp_path / "f.h5", said, atol=0.6 * STEP)
    assert not np.isfinite(convert([tmp_path / "f.h5"], said).recording.velocity[0, :, 0, 0, 0]).any()


def test_nrrd_states_the_unit_of_its_places_and_values(tmp_path: Path) -> None:
    nrrd = pytest.importorskip("nrrd", reason=EXTRA)
    nothing = np.full(3, np.nan)
    values = np.ascontiguousarray(1e2 * flow().transpose(1, 4, 3, 2, 0))
    for unit, per in (("mm", 1e3), ("cm", 1e2)):
        header = {
            "space": "left-posterior-superior",
            "kinds": ["vector", "domain", "domain", "domain", "time"],
            "space directions": np.array([nothing, *np.diag([per * 2e-3, per * 1.5e-3, per * 1e-3]), nothing]),
            "space origin": per * np.array([X[0], Y[0], Z[0]]),
            "space units": [unit] * 3,
            "sample units": "cm/s",
        }
        nrrd.write(str(tmp_path / "f.nrrd"), values, header)
        check(tmp_path / "f.nrrd", FieldMap(interval=0.02))
    header["sample units"] = "furlongs"
    nrrd.write(str(tmp_path / "f.nrrd"), values, header)
    with pytest.raises(FormatError, match=r"f\.nrrd: f: its attribute units: 'furlongs' is no unit of velocity"):
        convert([tmp_path / "f.nrrd"], FieldMap(interval=0.02))


@pytest.mark.parametrize(("unit", "per"), [("mm", 1e3), ("meter", 1.0), ("micron", 1e6)])
def test_nifti_of_scaled_integers(tmp_path: Path, unit: str, per: float) -> None:
    """RAS as the format asks: the first two axes run backwards in LPS, their components too."""
    nibabel = pytest.importorskip("nibabel", reason=EXTRA)
    affine = np.diag([-per * 2e-3, -per * 1.5e-3, per * 1e-3, 1.0])
    affine[:3, 3] = per * np.array([-X[0], -Y[0], Z[0]])
    values = flow() * np.array([-1, -1, 1]).reshape(1, 3, 1, 1, 1)
    counts = np.rint((values - 0.5) / STEP).astype(np.int16).transpose(4, 3, 2, 0, 1)
    image = nibabel.Nifti1Image(counts, affine)
    image.header.set_slope_inter(STEP, 0.5)
    image.header.set_xyzt_units(unit, "msec")
    image.header["pixdim"][4] = 20.0
    nibabel.save(image, tmp_path / "f.nii.gz")
    check(tmp_path / "f.nii.gz", atol=0.6 * STEP)


@pytest.mark.parametrize("kind", ["MET_SHORT", "MET_FLOAT"])
@pytest.mark.parametrize("big", [False, True])
def test_metaimage_of_one_file_beside_its_header(tmp_path: Path, kind: str, big: bool) -> None:
    """Counts of .05 mm/s, x axis backwards, the values in a file of their own."""
    pytest.importorskip("SimpleITK", reason=EXTRA)
    counts = np.rint(flow()[0] / STEP).transpose(1, 2, 3, 0)[:, :, ::-1]
    dtype = np.dtype("i2" if kind == "MET_SHORT" else "f4").newbyteorder(">" if big else "<")
    (tmp_path / "f.raw").write_bytes(np.ascontiguousarray(counts.astype(dtype)).tobytes())
    last = 1e3 * X[-1]
    lines = ["ObjectType = Image", "NDims = 3", "BinaryData = True", f"BinaryDataByteOrderMSB = {big}"]
    lines += ["TransformMatrix = -1 0 0 0 1 0 0 0 1", f"Offset = {last} {1e3 * Y[0]} {1e3 * Z[0]}"]
    lines += ["ElementSpacing = 2 1.5 1", f"DimSize = {len(X)} {len(Y)} {len(Z)}", "ElementNumberOfChannels = 3"]
    lines += [f"ElementType = {kind}", "ElementDataFile = f.raw"]
    (tmp_path / "f.mhd").write_text("\n".join(lines) + "\n")
    recording = convert([tmp_path / "f.mhd"], FieldMap(velocity_unit=str(STEP))).recording
    np.testing.assert_allclose(recording.velocity[0], flow()[0], atol=0.6 * STEP)
    np.testing.assert_allclose(recording.grid.origin, (X[0], Y[0], Z[0]), atol=1e-9)
    (tmp_path / "f.raw").unlink()
    with pytest.raises(FormatError, match=r"f\.(mhd|raw)"):
        convert([tmp_path / "f.mhd"])
