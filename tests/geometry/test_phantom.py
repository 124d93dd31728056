"""The shared phantom obeys the contract, and geometry reproduces what it states about itself."""

from __future__ import annotations

import numpy as np
import pytest
from paths import SHARED_DATA

from geometry import Recording, WallMotion, grid_winding, read_recording

FILES = ["lv_phantom_a.h5", "lv_phantom_a_measured.h5", "lv_phantom_a_noisy.h5"]

pytestmark = pytest.mark.phantom(*FILES)


def _read(name: str) -> Recording:
    return read_recording(SHARED_DATA / name)


@pytest.mark.parametrize("name", FILES)
def test_files_are_valid_recordings(name: str) -> None:
    recording = _read(name)
    assert recording.dimension == 3 and recording.wall.velocity is not None
    assert (recording.weight is None) == (name == FILES[0])


def test_volume_and_flux_follow_from_the_wall() -> None:
    recording = _read(FILES[0])
    motion = WallMotion.from_recording(recording)
    volume = [motion.volume(t) for t in recording.time]
    np.testing.assert_allclose(volume, recording.volume, rtol=1e-6)
    rate = np.array([motion.volume_rate(t) for t in recording.time])
    flux = recording.flux_mitral + recording.flux_aortic
    assert np.abs(rate - flux).max() < 0.03 * np.abs(flux).max()


def test_mask_is_what_the_surface_encloses() -> None:
    recording = _read(FILES[0])
    for frame in (0, 40, 80):
        surface = recording.wall.at(frame)
        inside = grid_winding(recording.grid, surface.vertices, surface.faces) > 0
        assert (inside != recording.mask[frame]).mean() < 0.002


def test_intervals_derived_from_the_states_agree_with_the_given_ones() -> None:
    recording = _read(FILES[0])
    given = recording.valve_intervals_or_derived()
    without = recording.select(slice(None))
    object.__setattr__(without, "valve_intervals", None)
    derived = without.valve_intervals_or_derived()
    assert derived[:, 0].tolist() == given[:, 0].tolist()
    seen = np.isfinite(derived[:, 1:])  # a change after the last frame is not in the states
    assert (given[:, 1:][~seen] > recording.time[-1]).all() and seen.sum() >= 3
    step = np.diff(recording.time).max()
    np.testing.assert_allclose(derived[:, 1:][seen], given[:, 1:][seen], atol=0.51 * step)
