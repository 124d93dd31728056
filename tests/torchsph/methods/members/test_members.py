"""Members: the frames that observers get, what is read out of them, the file that keeps them, draws of splines."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

import geometry
from torchsph import EnsembleOptions, PreparedMeasurement, Simulator, assimilate, preset
from torchsph.data import sample_measurement
from torchsph.haemodynamics import UNITS, FlowDomain, flow_quantities
from torchsph.methods.members.amplitude import Amplitude
from torchsph.methods.members.draws import spline_frames
from torchsph.methods.members.frames import MemberFrames
from torchsph.methods.members.kept import MemberFile, most_bytes, read_members, rounded
from torchsph.methods.members.quantities import MemberQuantities, quantified, with_pressure
from torchsph.methods.runtime.watching import Stopped
from torchsph.simulator.scene import Scene

MEMBERS = 3


class Given:
    """A measurement with all that its runs share."""

    def __init__(self) -> None:
        self.measured = geometry.read_recording(sample_measurement()).select(slice(10, 14))
        self.prepared = PreparedMeasurement(self.measured)
        self.model = Simulator(Scene.from_recording(self.measured, 3.5e-3), preset("default"))

    def run(self, **more):
        known = {"members": MEMBERS, "seed": 1, "options": EnsembleOptions(batch=2)}
        return assimilate(self.prepared, self.model, **known | more)


class Kept:
    """An observer that keeps what it gets."""

    def __init__(self) -> None:
        self.frames = []

    def take(self, frame):
        self.frames.append(frame)

    def state(self):
        return {}

    def restore(self, state):
        pass


class OnceStopped:
    """A watcher that ends the run after one frame."""

    def __init__(self, after):
        self.after, self.done = after, -1

    def begins(self):
        pass

    def frame_done(self, done):
        self.done = done.frame

    def asked_to_stop(self):
        return self.done == self.after


@pytest.fixture(scope="module")
def given():
    return Given()


@pytest.fixture(scope="module")
def followed(given, tmp_path_factory):
    """A run with observers: its recording, the frames, the quantities, and the file."""
    path = tmp_path_factory.mktemp("members") / "members.h5"
    kept, quantities = Kept(), MemberQuantities(given.measured)
    run = given.run(observers=[kept, quantities, MemberFile(path, given.measured, MEMBERS)])
    return run.recording, kept.frames, quantities.found(), path


def test_looking_on_changes_no_bit(given, followed):
    np.testing.assert_array_equal(given.run().recording.velocity, followed[0].velocity)


def test_members_lie_around_the_analysis_as_far_as_it_claims(given, followed):
    """Beside the factor that each has on all but the flow that the walls drive."""
    recording, frames, _, _ = followed
    amplitude = Amplitude(given.prepared.balance, given.prepared.amplitude_error, MEMBERS, seed=1)
    assert 0 < given.prepared.amplitude_error < 0.5
    assert [frame.frame for frame in frames] == [0, 1, 2, 3]
    for frame in frames:
        np.testing.assert_array_equal(frame.field, recording.velocity[frame.frame])
        np.testing.assert_allclose(frame.members.mean(0), frame.field, atol=1e-6)
        inside = np.asarray(recording.mask[frame.frame], bool)
        own = frame.members - inside * amplitude.of_fields(torch.from_numpy(frame.field), frame.frame).numpy()
        np.testing.assert_allclose(own.std(0, ddof=1), recording.sigma[frame.frame], atol=1e-6)
        assert np.isfinite(frame.pressure[inside]).mean() > 0.99
        assert np.abs(frame.rate[:, inside]).mean() > 0 and (frame.member_rates[:, :, inside] != 0).any()


def test_quantities_are_those_of_every_member(given, followed):
    recording, frames, found, _ = followed
    one = np.stack([frame.members[1] for frame in frames])
    alone = flow_quantities(FlowDomain.from_recording(recording), one)
    for name in set(UNITS) - {"force_axial", "force_across", "pressure_difference"}:  # which ask for du/dt
        np.testing.assert_allclose(found.members[name][1], alone[name], rtol=1e-6, err_msg=name)
    bands = found.bands()
    # the estimate as its measurement's kernel shows it once more is read out as well, and only widens the bands
    assert all(frame.coarser is not None and frame.coarser.shape == frame.field.shape for frame in frames)
    for name in UNITS:
        lost = np.abs(found.estimate[name] - found.coarser[name])
        assert (bands[name].deviation >= np.maximum(found.members[name].std(0, ddof=1), lost) * (1 - 1e-9)).all(), name
    assert all((bands[name].deviation > 0).all() for name in ("kinetic_energy", "energy_loss", "pressure_difference"))
    # a quadratic of the mean is smaller than the mean of the quadratic
    assert (bands["kinetic_energy"].mean > found.estimate["kinetic_energy"]).all()
    whole = with_pressure(recording, found)
    geometry.check_recording(whole, "with pressure")
    assert (whole.pressure_sigma >= 0).all() and whole.pressure_sigma.any()
    assert with_pressure(recording, None) is recording


def test_kept_members_give_the_same_quantities(given, followed, tmp_path):
    recording, frames, found, path = followed
    again = quantified(recording, read_members(path, recording))
    for name in UNITS:
        tolerance = {"rtol": 2e-2, "atol": 1e-3 * np.abs(found.members[name]).max()}
        np.testing.assert_allclose(again.coarser[name], found.coarser[name], **tolerance)
        np.testing.assert_allclose(
            again.members[name], found.members[name], rtol=2e-2, atol=1e-3 * np.abs(found.members[name]).max()
        )
    assert path.stat().st_size < most_bytes(recording, MEMBERS)
    half = tmp_path / "half.h5"
    half.write_bytes(path.read_bytes())
    with h5py.File(half, "r+") as file:
        file.attrs["frames_done"] = 2
    with pytest.raises(ValueError, match="holds only 2 of 4 frames"):
        next(read_members(half, recording))
    with pytest.raises(ValueError, match="not those of the analysis"):
        next(read_members(path, recording.select(slice(0, 3))))
    with pytest.raises(FileNotFoundError, match="no such file"):
        next(read_members(tmp_path / "none.h5", recording))


@pytest.mark.slow
def test_a_restart_goes_on_with_members(given, followed, tmp_path):
    recording, _, found, _ = followed
    saved, path = tmp_path / "c.pt", tmp_path / "members.h5"

    def observers():
        return [MemberQuantities(given.measured), MemberFile(path, given.measured, MEMBERS)]

    with pytest.raises(Stopped):
        given.run(observers=observers(), checkpoints=saved, watcher=OnceStopped(1))
    read = observers()
    given.run(observers=read, checkpoints=saved, resume=True)
    for name in UNITS:
        np.testing.assert_array_equal(read[0].found().members[name], found.members[name])
    assert sum(1 for _ in read_members(path, recording)) == recording.frames
    with pytest.raises(Stopped):
        given.run(observers=observers(), checkpoints=saved, watcher=OnceStopped(1))
    path.unlink()
    with pytest.raises(ValueError, match="members kept so far are gone"):
        given.run(observers=observers(), checkpoints=saved, resume=True)
    with pytest.raises(Stopped):
        given.run(checkpoints=saved, watcher=OnceStopped(1))
    with pytest.raises(ValueError, match="holds no members"):
        given.run(observers=observers(), checkpoints=saved, resume=True)


def test_a_frame_that_cannot_be_read_costs_the_quantities_alone(followed):
    recording, frames, _, _ = followed
    closed = replace(recording, wall=replace(recording.wall, region=np.zeros_like(recording.wall.region)))
    with pytest.raises(ValueError, match="no orifice"):
        MemberQuantities(closed).take(frames[0])
    tolerant = MemberQuantities(closed, strict=False)
    with pytest.warns(RuntimeWarning, match="no quantities are read out: .* no orifice"):
        tolerant.take(frames[0])
    tolerant.take(frames[1])
    assert "no orifice" in tolerant.fault
    again = MemberQuantities(closed)
    again.restore(tolerant.state())
    assert again.fault == tolerant.fault


def test_a_lag_is_refused(given):
    with pytest.raises(ValueError, match="without a lag alone"):
        given.run(observers=[Kept()], options=EnsembleOptions(lag=2))


def test_a_full_disk_is_told_before_the_run(given, monkeypatch, tmp_path):
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 1000})())
    with pytest.raises(OSError, match="only 0 MB are free"):
        MemberFile(tmp_path / "members.h5", given.measured, MEMBERS)


def test_rates_at_a_frame_from_both_sides_of_it(given):
    recording = replace(given.measured, valve_intervals=np.array([[2.0, -np.inf, given.measured.time[2] + 1e-3]]))
    kept, shape = Kept(), given.measured.velocity.shape[1:]
    frames = MemberFrames(recording, [kept])
    field = torch.zeros(shape)
    failed = torch.tensor([False, True, False])
    for frame in range(4):
        frames.analysed(frame, field, torch.zeros(MEMBERS, *shape))
        if frame == 3:
            frames.finish()
            break
        members = torch.stack([torch.full(shape, v) for v in (1.0 + frame, np.nan, 3.0 + frame)])
        rate = torch.full(shape, 10.0 * (frame + 1))
        rate[:, 0] = torch.nan if frame == 0 else 7.0
        pressure = torch.arange(float(np.prod(shape[1:]))).reshape(shape[1:]).repeat(2, 1, 1, 1) + 100.0 * frame
        frames.forecast(rate, members, failed, pressure)
    levels = [float(frame.rate[0, 1, 0, 0]) for frame in kept.frames]
    assert levels == [10.0, 15.0, 20.0, 30.0]  # ends: one side; frame 2: a valve shuts behind it
    assert [float(frame.rate[0, 0, 0, 0]) for frame in kept.frames] == [0.0, 7.0, 7.0, 7.0]
    # members lie around the estimate as they lie around their own mean; one that failed has what the estimate has
    assert [float(frame.member_rates[0, 0, 1, 0, 0]) for frame in kept.frames] == [9.0, 14.0, 19.0, 29.0]
    assert [float(frame.member_rates[1, 0, 1, 0, 0]) for frame in kept.frames] == levels
    inside = np.asarray(recording.mask[1], bool)
    assert abs(kept.frames[1].pressure[inside].mean()) < 1e-2 and np.isnan(kept.frames[1].pressure[~inside]).all()


def test_rounding_keeps_twelve_bits():
    values = np.random.default_rng(0).standard_normal(1000).astype(np.float32)
    kept = rounded(values)
    assert np.abs(kept / values - 1).max() < 2.0**-12
    assert not (kept.view(np.uint32) & 0x7FF).any()
    assert np.isnan(rounded(np.array([np.nan], np.float32))).all()


@pytest.mark.slow
def test_draws_of_splines_have_their_deviation_and_repeat(given):
    splines, smoothed = given.prepared.splines, given.prepared.smoothed
    frames = list(spline_frames(splines, smoothed, 8, seed=3))
    mask = np.asarray(smoothed.mask[2], bool)
    fitted = splines.fit(2, uncertainty=True)
    stated = fitted.std(splines.nodes[torch.from_numpy(mask.reshape(-1))]).double().square().mean(0).sqrt().numpy()
    drawn = (frames[2].members - frames[2].field)[:, :, mask]
    np.testing.assert_allclose(np.sqrt((drawn**2).mean((0, 2))), stated, rtol=0.02)
    again = next(f for f in spline_frames(splines, smoothed, 8, seed=3) if f.frame == 2)
    np.testing.assert_array_equal(again.members, frames[2].members)
    curves = quantified(smoothed, frames)
    alone = flow_quantities(FlowDomain.from_recording(smoothed), smoothed.velocity)
    for name in UNITS:
        np.testing.assert_allclose(curves.estimate[name], alone[name], rtol=1e-4, atol=1e-4 * np.abs(alone[name]).max())
    with pytest.raises(ValueError, match="at least 2 members"):
        next(spline_frames(splines, smoothed, 1))
