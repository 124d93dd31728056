"""The same seed gives the same bits for any number of threads, again and again, beside a busy process too."""

import multiprocessing
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

import geometry
import regularize
from torchsph import PreparedMeasurement, Scene, Simulator, assimilate, filter_sph, preset
from torchsph.data import sample_measurement


@contextmanager
def threads(number):
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _spin():
    while True:
        pass


@contextmanager
def busy_process():
    """Another process that takes a core, so that threads arrive in another order every time."""
    process = multiprocessing.get_context("spawn").Process(target=_spin, daemon=True)
    process.start()
    try:
        yield
    finally:
        process.kill()
        process.join()


def frames(first, last):
    return geometry.read_recording(sample_measurement()).select(slice(first, last))


def test_splines_have_the_same_bits_with_any_number_of_threads():
    measured, found = frames(9, 10), []
    for number in (1, 2):
        with threads(number):
            found.append(PreparedMeasurement(measured).smoothed.velocity)
    np.testing.assert_array_equal(found[0], found[1])


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["default", "weakly_compressible"])
def test_every_method_has_the_same_bits_with_any_number_of_threads(scheme):
    """Splines, ensemble and particle filter of three frames; minutes, for 1, 2 and 3 threads twice."""
    measured, found = frames(9, 12), []
    model = Simulator(Scene.from_recording(measured, 3e-3), preset(scheme))
    for number in (1, 2, 3, 1, 2, 3):
        with threads(number), busy_process():
            prepared = PreparedMeasurement(measured)
            run = assimilate(prepared, model, members=4, seed=1).recording
            particles = filter_sph(prepared, model, seed=1).recording
            found.append([prepared.smoothed.velocity, run.velocity, run.sigma, particles.velocity])
    for other in found[1:]:
        for mine, first in zip(other, found[0], strict=True):
            np.testing.assert_array_equal(mine, first)


FIT = """
import hashlib, torch, regularize
draw = torch.Generator().manual_seed(0)
points = 0.02 * torch.rand(300, 3, generator=draw, dtype=torch.float64)
values = torch.randn(300, 3, generator=draw, dtype=torch.float64)
smoother = regularize.Smoother(knots=2.0, spacing=(5e-3,) * 3, divergence=0.02, curvature=3e-3)
print(hashlib.sha256(smoother.fit(points, values).coefficients.numpy().tobytes()).hexdigest())
"""


def test_splines_have_the_same_bits_whatever_threads_a_process_starts_with(tmp_path):
    """SciPy's BLAS reads OMP_NUM_THREADS when it is loaded, and its sums depended on it."""
    root = str(Path(regularize.__file__).parents[1])
    found = set()
    for number in ("1", "2"):
        environment = {**os.environ, "OMP_NUM_THREADS": number, "OPENBLAS_NUM_THREADS": number, "PYTHONPATH": root}
        call = [sys.executable, "-W", "ignore", "-c", FIT]
        found.add(subprocess.run(call, cwd=tmp_path, env=environment, check=True, capture_output=True).stdout)
    assert len(found) == 1


def numbers_in(path):
    """Every array of an HDF5 file."""
    with h5py.File(path) as file:
        names: list[str] = []
        file.visit(names.append)
        return {name: file[name][()] for name in names if isinstance(file[name], h5py.Dataset)}


@pytest.mark.slow
def test_every_method_has_the_same_bits_whatever_threads_and_workers_a_process_starts_with(tmp_path):
    """The command line on two frames, with 1, 2 and 3 threads and workers, twice beside a busy process; minutes.

    Both copies of OpenBLAS, numpy's and SciPy's, read the number of threads when they are loaded.
    """
    geometry.write_recording(tmp_path / "m.h5", frames(9, 11))
    root, found = str(Path(regularize.__file__).parents[1]), {}
    settings = [(threads, 1) for threads in (1, 2, 3)] + [(1, 2), (1, 3), (2, 2)]
    for turn, (threads, workers) in enumerate(2 * settings):
        number = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
        options = f"--method ensemble --members 4 --spacing 4e-3 --seed 1 --keep-members --no-page --workers {workers}"
        call = [sys.executable, "-W", "ignore", "-m", "torchsph", "assimilate", "m.h5", "--out", f"r{turn}"]
        with busy_process():
            environment = {**os.environ, **number, "PYTHONPATH": root}
            subprocess.run([*call, *options.split()], cwd=tmp_path, env=environment, check=True, capture_output=True)
        found[turn, threads, workers] = {
            f"{path.name} {name}": values
            for path in sorted((tmp_path / f"r{turn}").glob("*.h5"))
            for name, values in numbers_in(path).items()
        }
    first, *others = found.values()
    assert any(name.startswith("members.h5") for name in first)
    for other in others:
        assert other.keys() == first.keys()
        for name, values in first.items():
            np.testing.assert_array_equal(values, other[name], str(name))
