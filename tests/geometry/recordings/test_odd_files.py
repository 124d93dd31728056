"""Odd, damaged and lying HDF5 files end in a RecordingError that names the file and what of it is at fault."""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from geometry import Recording, RecordingError, read_recording, write_recording
from geometry.recordings.recording import LAYOUT


@pytest.fixture(name="path")
def _path(box_recording: Callable[..., Recording], tmp_path: Path) -> Path:
    path = tmp_path / "box.h5"
    recording = box_recording(lambda points, t: 0.1 * np.cos(100 * points + t), nodes=4, volume=[1e-6] * 3)
    write_recording(path, recording)
    return path


def _named_type(file: h5py.File, name: str) -> None:
    file[name] = np.dtype("f8")


def _null(file: h5py.File, name: str) -> None:
    file[name] = h5py.Empty("f8")


def _group(file: h5py.File, name: str) -> None:
    file.create_group(name)


def _references(file: h5py.File, name: str) -> None:
    file.create_dataset(name, data=[file.ref], dtype=h5py.ref_dtype)


def _ragged(file: h5py.File, name: str) -> None:
    file.create_dataset(name, (3,), dtype=h5py.vlen_dtype("f8"))


def _compound(file: h5py.File, name: str) -> None:
    file.create_dataset(name, (3,), dtype=[("x", "f8"), ("y", "f8")])


def _subarrays(file: h5py.File, name: str) -> None:
    file.create_dataset(name, (3,), dtype=np.dtype(("f8", (1000,))))


def _texts(file: h5py.File, name: str) -> None:
    file.create_dataset(name, data=["a", "b", "c"], dtype=h5py.string_dtype())


def _complex(file: h5py.File, name: str) -> None:
    file.create_dataset(name, data=np.ones(3, complex))


def _scalar(file: h5py.File, name: str) -> None:
    file[name] = 1.0


def _to_itself(file: h5py.File, name: str) -> None:
    file[name] = h5py.SoftLink(".")


def _dangling(file: h5py.File, name: str) -> None:
    file[name] = h5py.SoftLink("/nowhere/./at/../all")


ODD = (
    _named_type,
    _null,
    _group,
    _references,
    _ragged,
    _compound,
    _subarrays,
    _texts,
    _complex,
    _scalar,
    _to_itself,
    _dangling,
)


@pytest.mark.parametrize("make", ODD, ids=[make.__name__ for make in ODD])
def test_objects_of_another_kind_are_refused_by_their_name(make: Callable, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        there = [dataset for _, dataset, _ in LAYOUT if dataset in file]
    whole = path.read_bytes()
    for dataset in there:
        path.write_bytes(whole)
        with h5py.File(path, "r+") as file:
            del file[dataset]
            make(file, dataset)
        if make is _dangling and dataset in ("/volume", "/wall/velocity"):
            assert dataset not in read_recording(path).arrays()  # an optional dataset that is not there
            continue
        with pytest.raises(RecordingError, match="box.h5: /") as caught:
            read_recording(path)
        assert caught.value.dataset == dataset or make in (_dangling, _scalar)
        assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("name", ["format", "format_version", "dimension", "rho", "mu", "period"])
@pytest.mark.parametrize(
    "value",
    [h5py.Empty("f8"), "\udcff", [1.0, 2.0], np.zeros(5000), "x" * 60000, 1 + 2j],
    ids=["empty", "not UTF-8", "two", "many", "long", "complex"],
)
def test_attributes_of_another_kind_are_refused_by_their_name(name: str, value: object, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value.encode("utf-8", "surrogateescape") if isinstance(value, str) else value
    with pytest.raises(RecordingError, match=f"box.h5: attribute {name}: must be") as caught:
        read_recording(path)
    assert len(str(caught.value)) < 1000


def test_a_description_in_another_encoding_is_read_as_text(path: Path) -> None:
    for stored, read in ((b"M\xfcller", "M\ufffdller"), ("Müller".encode(), "Müller"), (h5py.Empty("S1"), "")):
        with h5py.File(path, "r+") as file:
            file.attrs["description"] = stored
        recording = read_recording(path)
        assert recording.description == read
        write_recording(path, recording)


@pytest.mark.parametrize("count", [10**9, 10**12, 2**62])
@pytest.mark.parametrize("dataset", ["/time", "/velocity", "/mask", "/wall/faces", "/wall/region", "/volume"])
def test_declared_sizes_are_compared_before_anything_is_read(dataset: str, count: int, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        shape, kind = (count, *file[dataset].shape[1:]), file[dataset].dtype
        del file[dataset]
        if dataset == "/velocity" and count == 2**62:
            shape = (*file["mask"].shape[:1], 3, *file["mask"].shape[1:-1], count // 2**20)
        file.create_dataset(dataset, shape, kind, chunks=tuple(min(n, 1024) for n in shape), compression="gzip")
    with pytest.raises(RecordingError, match=r"box.h5: /.*(has the shape|no array can have)"):
        read_recording(path)


def test_sizes_that_agree_but_are_not_on_the_disk_are_refused(path: Path) -> None:
    """A file of some kB in which every dataset declares 10^8 frames, or a chunk of 1 GB."""
    whole, frames = path.read_bytes(), 10**8
    with h5py.File(path, "r+") as file:
        for _, dataset, _ in LAYOUT:
            if dataset in file and dataset not in ("/wall/faces", "/wall/region"):
                shape, kind = (frames, *file[dataset].shape[1:]), file[dataset].dtype
                del file[dataset]
                file.create_dataset(dataset, shape, kind, chunks=(1, *shape[1:]))
    with pytest.raises(RecordingError, match=r"box.h5: /velocity: declares .*but the whole file has"):
        read_recording(path)
    path.write_bytes(whole)
    with h5py.File(path, "r+") as file:
        del file["volume"]
        file.create_dataset("volume", (3,), "f8", maxshape=(None,), chunks=(1 << 27,), compression="gzip")
    with pytest.raises(RecordingError, match="box.h5: /volume: declares"):
        read_recording(path)


def test_what_was_never_written_is_read_where_it_is_small(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        shape = file["mask"].shape
        file.create_dataset("pressure", shape, "f4", chunks=(1, *shape[1:]))
    assert not read_recording(path).pressure.any()


def test_damage_is_told_or_harmless(path: Path) -> None:
    """A bit at a time, and the file cut at many lengths: in a process of its own, since HDF5 reads them."""
    program = """
import sys
from pathlib import Path
from geometry import RecordingError, read_recording
path = Path(sys.argv[1])
whole, refused = path.read_bytes(), 0
steps = [(n, 0) for n in range(0, len(whole), len(whole) // 30)]
steps += [(n, 1 << n % 8) for n in range(0, len(whole), len(whole) // 200)]
for place, bit in steps:
    data = bytearray(whole if bit else whole[:place])
    if bit:
        data[place] ^= bit
    path.write_bytes(data)
    try:
        read_recording(path)
    except RecordingError as fault:
        assert str(fault).startswith(f"{path}: ") and len(str(fault)) < 1000, fault
        refused += 1
print(refused)
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=path.parent,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30)),
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 30  # every shortened file at least
