"""A tracker that is a C library, built here, gives what ours gives to the nearest node."""

import shutil
import subprocess
from pathlib import Path

import pytest
import torch
from ultrasound_cases import STEP, cube, lattice, packet

from torchsph.ultrasound.acquisition import Beams
from torchsph.ultrasound.estimation.estimates import Flag
from torchsph.ultrasound.estimation.plugin import LibraryTracker, Tracker
from torchsph.ultrasound.estimation.tracking import SpeckleTracker

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
SOURCE = Path(__file__).parent / "tracker.c"


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    if COMPILER is None:
        pytest.skip("no C compiler")
    path = tmp_path_factory.mktemp("tracker") / "libtracker.so"
    command = [
        COMPILER,
        "-std=c11",
        "-O2",
        "-Wall",
        "-Werror",
        "-shared",
        "-fPIC",
        str(SOURCE),
        "-o",
        str(path),
        "-lm",
    ]
    subprocess.run(command, check=True, timeout=60)
    return path


def node_speed(scene, nodes):
    return nodes * STEP / scene.acquisition.interval


def test_whole_node_motion_in_space_and_in_a_plane(library):
    step = node_speed(packet((0.0,) * 3, grid=cube(4)), 1)
    for velocity, scene, points in (
        ((step, 0.0, -step), packet((step, 0.0, -step), 1, grid=cube(12)), lattice(half=1)),
        (
            (-step, step),
            packet((-step, step), 1, grid=cube(20, (0.0, 20e-3)), beams=Beams((0.0, 1.0))),
            lattice((0.0, 20e-3), 1),
        ),
    ):
        tracker: Tracker = LibraryTracker(library)
        found = tracker.track(scene, points)
        assert found.velocity.shape == (len(points), len(velocity))
        assert (found.velocity - torch.tensor(velocity)).abs().amax(1).lt(1e-6).float().mean() > 0.9
        ours = SpeckleTracker(clutter=None, lags=(1,)).track(scene, points)
        assert (found.velocity - ours.velocity).abs().median() < 0.25 * step
        torch.testing.assert_close(found.correlation, ours.correlation, atol=0.03, rtol=0)


def test_low_correlation_is_flagged(library):
    found = LibraryTracker(library, min_correlation=0.9999).track(
        packet((0.1, 0.1, 0.1), 2, grid=cube(8)), lattice(half=0)
    )
    assert not found.accepted.any() and int(found.flags[0]) & Flag.DECORRELATED


def test_errors_of_the_library_and_of_its_place(library, tmp_path):
    scene = packet((0.0, 0.0, 0.0), 3, grid=cube(4))
    with pytest.raises(RuntimeError, match="code 7"):
        LibraryTracker(library).track(scene.with_iq(scene.iq[:1]), lattice(half=0))
    with pytest.raises(FileNotFoundError, match="missing.so"):
        LibraryTracker(tmp_path / "missing.so")
    (tmp_path / "text.so").write_text("no library")
    with pytest.raises(ValueError, match="not a shared library"):
        LibraryTracker(tmp_path / "text.so")
    empty = tmp_path / "empty.so"
    source = tmp_path / "empty.c"
    source.write_text("int other;\n")
    subprocess.run([COMPILER, "-shared", "-fPIC", str(source), "-o", str(empty)], check=True, timeout=60)
    with pytest.raises(ValueError, match="speckle_track"):
        LibraryTracker(empty)
