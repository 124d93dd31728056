"""The ensemble's cycle under what goes wrong: gaps, failures, restarts, several processes, one component alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as multiprocessing

import geometry
import torchsph
from torchsph import EnsembleOptions, Estimated, PreparedMeasurement, Simulator, assimilate, preset
from torchsph.assimilation import Parameter
from torchsph.data import sample_measurement, sample_truth
from torchsph.methods.ensemble.cycle import Cycle
from torchsph.methods.ensemble.divergence_cleaning import Cleaned
from torchsph.methods.ensemble.forecaster import Ensemble, Forecaster
from torchsph.methods.runtime.watching import FrameDone
from torchsph.methods.runtime.watching import Stopped as AskedToStop
from torchsph.simulator.scene import Scene

FRAMES = slice(10, 14)
WIDE = 3.5e-3  # m, particles so coarse that a cycle takes a fraction of a second
FINE = 1.5e-3  # m, where the forecast itself has to be good


def made_model(measured, spacing=WIDE):
    return Simulator(Scene.from_recording(measured, spacing), preset("default"))


class Given:
    """A measurement with all that its runs share."""

    def __init__(self) -> None:
        self.measured = geometry.read_recording(sample_measurement()).select(FRAMES)
        self.prepared = PreparedMeasurement(self.measured)
        self.smoothed = self.prepared.smoothed
        self.model = made_model(self.measured)

    def run(self, **more):
        known = {"members": 3, "seed": 1, "options": EnsembleOptions(batch=2)}
        return assimilate(self.prepared, self.model, **known | more)


@pytest.fixture(scope="module")
def given():
    return Given()


@pytest.fixture(scope="module")
def plain(given):
    return given.run()


def truth_of(measured):
    every = geometry.read_recording(sample_truth())
    return every.velocity[[int(np.abs(every.time - t).argmin()) for t in measured.time]]


def nrmse(recording):
    right, inside = truth_of(recording), np.asarray(recording.mask, bool)
    difference = np.moveaxis(recording.velocity - right, 1, -1)[inside]
    return float(np.sqrt(np.square(difference).sum() / np.square(np.moveaxis(right, 1, -1)[inside]).sum()))


def assert_same(one, other):
    np.testing.assert_array_equal(one.recording.velocity, other.recording.velocity)
    np.testing.assert_array_equal(one.recording.sigma, other.recording.sigma)
    assert one.info["filter"] == other.info["filter"]
    assert one.info["shocks"] == other.info["shocks"]


class Stopped(RuntimeError):
    pass


class StopAfterTwo:
    """Asks a run to stop when two frames are done, and keeps what it was told."""

    def __init__(self) -> None:
        self.told: list[FrameDone] = []

    def begins(self) -> None:
        assert not self.told

    def frame_done(self, done: FrameDone) -> None:
        self.told.append(done)

    def asked_to_stop(self) -> bool:
        return len(self.told) == 2


def test_a_restart_in_the_middle_changes_no_bit(given, plain, tmp_path):
    path, watcher = tmp_path / "checkpoint.pt", StopAfterTwo()
    with pytest.raises(AskedToStop, match="stopped after frame 2 of 4"):
        given.run(checkpoints=path, watcher=watcher)
    assert watcher.told == [FrameDone(frame, 4, alive=3, members=3) for frame in range(2)]
    with pytest.raises(ValueError, match="belongs to a run with another seed"):
        given.run(checkpoints=path, resume=True, seed=2)
    assert_same(given.run(checkpoints=path, resume=True), plain)
    assert [shock["time"] for shock in plain.info["shocks"]] == given.measured.time[:-1].tolist()
    assert all(0 < shock["shock"] < 0.3 for shock in plain.info["shocks"])
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.pt"]


@pytest.mark.slow
def test_later_frames_improve_earlier_analyses_alone(given, plain, tmp_path, monkeypatch):
    """The last analysis and all forecasts stay; earlier ones come nearer to the next data; a restart changes no bit."""
    options = EnsembleOptions(batch=2, lag=2)
    late = given.run(options=options)
    np.testing.assert_array_equal(late.recording.velocity[-1], plain.recording.velocity[-1])
    assert late.info["filter"] == plain.info["filter"]
    inside = np.asarray(given.measured.mask, bool)[:-1]
    moved, sure, known = (
        np.moveaxis(part[:-1], 1, -1)[inside]
        for part in (late.recording.velocity - plain.recording.velocity, late.recording.sigma, plain.recording.sigma)
    )
    assert 0 < np.square(moved).mean() < np.square(known).mean()
    assert np.square(sure).mean() < np.square(known).mean()

    def stopping(self, frame, step=Cycle.step):
        if frame == 2:
            raise Stopped
        step(self, frame)

    with monkeypatch.context() as patch:
        patch.setattr(Cycle, "step", stopping)
        with pytest.raises(Stopped):
            given.run(options=options, checkpoints=tmp_path / "late.pt")
    assert_same(given.run(options=options, checkpoints=tmp_path / "late.pt", resume=True), late)


def take_part(rank: int, processes: int, folder: str) -> None:
    dist.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=processes)
    torch.set_num_threads(1)
    run = Given().run()
    torch.save((run.recording.velocity, run.recording.sigma), f"{folder}/{rank}.pt")
    dist.destroy_process_group()


@pytest.mark.slow
def test_two_processes_make_the_same_analysis(plain, tmp_path):
    multiprocessing.spawn(take_part, (2, str(tmp_path)), nprocs=2)
    for rank in range(2):
        velocity, sigma = torch.load(tmp_path / f"{rank}.pt", weights_only=False)
        np.testing.assert_array_equal(velocity, plain.recording.velocity)
        np.testing.assert_array_equal(sigma, plain.recording.sigma)


def silenced(measured, frames):
    weight = np.array(measured.weight)
    weight[frames] = 0.0
    return replace(measured, weight=weight)


@pytest.mark.parametrize(
    "frames", [[1, 2], pytest.param([0], marks=pytest.mark.slow), pytest.param([0, 1, 2, 3], marks=pytest.mark.slow)]
)
def test_frames_without_data_are_forecast(given, frames):
    measured = silenced(given.measured, frames)
    if len(frames) == measured.frames:
        with pytest.raises(ValueError, match="no node with a positive weight"):
            assimilate(measured, given.model, members=2)
        return
    run = assimilate(measured, given.model, members=2, seed=1)
    geometry.check_recording(run.recording, "ensemble")
    assert run.info["coasted_frames"] == len([f for f in frames if f > 0])
    counts = run.info["filter"]["cycles"]
    for frame in frames:
        if frame:
            assert set(counts[frame - 1]["observations"]) == {"no_weight"}
    assert nrmse(run.recording) < 1.0


@pytest.mark.slow  # a quarter of a minute
def test_ten_frames_without_data_are_forecast_and_their_uncertainty_grows():
    every = geometry.read_recording(sample_measurement()).select(slice(2, 15))
    measured = silenced(every, list(range(1, 11)))
    run = assimilate(measured, made_model(measured), members=2, seed=1)
    assert run.info["coasted_frames"] == 10
    assert any(
        "no observation was used in this cycle" in words and "10 of 12" in words
        for words in run.info["filter"]["warnings"]
    )
    sigma = [float(np.square(run.recording.sigma[f]).mean()) ** 0.5 for f in range(measured.frames)]
    assert sigma[10] > 1.2 * sigma[1]
    # blind through the opening of the valve, it finds back in two analyses: measured .74 before and .45 after
    assert nrmse(run.recording.select([12])) < 0.7 * nrmse(run.recording.select([10]))


def test_an_ensemble_without_spread_still_follows_the_measurement_and_says_so(given, plain, monkeypatch):
    first = Cycle._first
    none = torch.zeros(2, 1, 1, 1, 1)
    monkeypatch.setattr(Cycle, "_first", lambda self, generator: (first(self, generator)[0], none))
    run = given.run(members=2, options=EnsembleOptions(model_error=0.0))
    assert np.isfinite(run.recording.velocity).all() and not run.recording.sigma.any()
    assert any("collapsed" in words for words in run.info["filter"]["warnings"])
    assert nrmse(run.recording) < 1.1 * nrmse(plain.recording)


def test_members_that_fail_are_replaced_and_the_events_recorded(given, monkeypatch):
    """A member is lost in each cycle, once all of them and once the control."""
    advance, cycles = Forecaster.advance, iter(range(10))

    def failing(self, ensemble, *where):
        found, cycle = advance(self, ensemble, *where), next(cycles)
        lost = torch.zeros(len(found.failed), dtype=torch.bool)
        lost[cycle % len(lost)] = True
        lost |= cycle == 1
        for state in found.states:
            state.members[lost] = torch.nan
        return replace(found, failed=lost, control_failed=cycle == 2)

    monkeypatch.setattr(Forecaster, "advance", failing)
    run = given.run()
    assert np.isfinite(run.recording.velocity).all() and np.isfinite(run.recording.sigma).all()
    events = [event["failed"] for event in run.info["events"]]
    assert events == [0, [0, 1, 2], "control", 2]
    assert run.info["replaced_members"] == 4


def test_a_run_ends_where_fewer_members_live_than_asked_for(given, tmp_path, monkeypatch):
    advance = Forecaster.advance

    def failing(self, ensemble, *where):
        found = advance(self, ensemble, *where)
        return replace(found, failed=torch.tensor([True, False, True]))

    monkeypatch.setattr(Forecaster, "advance", failing)
    options = EnsembleOptions(batch=2, minimum_members=2)
    with pytest.raises(
        torchsph.NumericalFailure, match="1 of 3 members lived through the forecast to .*fewer than the 2"
    ):
        given.run(options=options, checkpoints=tmp_path / "c.pt")
    assert (tmp_path / "c.pt").is_file()
    with pytest.raises(ValueError, match="minimum_members is 4, but there are only 3"):
        given.run(options=EnsembleOptions(minimum_members=4))


def test_an_analysis_whose_divergence_stays_is_counted_and_warned_of(given, monkeypatch):
    def failing(velocity, mask, spacing):
        return Cleaned(velocity, 1.0, False)

    monkeypatch.setattr("torchsph.methods.ensemble.analyses.without_divergence", failing)
    with pytest.warns(RuntimeWarning, match="divergence did not converge in 4 analyses"):
        run = given.run(members=2)
    assert run.info["divergence_not_converged"] == 4


def test_a_failing_control_is_the_members_mean(given):
    """The real path: NaN in the control's start breaks the run of the control alone."""
    state = torch.from_numpy(given.smoothed.velocity[0])
    broken = state.clone()
    broken[0, given.measured.mask[0].nonzero()[0][0]] = 1e30
    ahead = Forecaster(given.model, given.model, given.measured.grid, EnsembleOptions().transfer)
    masks = [torch.from_numpy(np.array(given.measured.mask[f], bool)) for f in (0, 1)]
    ensemble = Ensemble(broken, state.repeat(2, 1, 1, 1, 1))
    start, end = (float(t) for t in given.measured.time[:2])
    found = ahead.advance(ensemble, start, masks[0], [end], [masks[1]])
    assert found.control_failed and not found.failed.any()
    torch.testing.assert_close(found.states[0].control, found.states[0].members.mean(0))


def along_z(measured):
    """What a probe above would see of it: the component along z alone."""
    beam = np.zeros((3, *measured.grid.shape), np.float32)
    beam[2] = 1.0
    return replace(measured, velocity=measured.velocity * beam, beam=beam)


@pytest.mark.slow
def test_one_component_alone_beats_its_spline(given):
    doppler = along_z(given.measured)
    prepared, fine = PreparedMeasurement(doppler), made_model(doppler, FINE)
    run = assimilate(prepared, fine, coarse=given.model, members=3, seed=1)
    assert run.recording.beam is None
    assert nrmse(run.recording) < nrmse(prepared.smoothed)


@pytest.mark.slow  # half a minute
def test_a_second_measurement_of_other_grid_and_times_helps(given):
    """The truth of every other node, seen along z every 5 ms, almost without noise."""
    fine = made_model(given.measured, FINE)
    plain = assimilate(given.prepared, fine, coarse=given.model, members=3)
    every = geometry.read_recording(sample_truth())
    near = every.select((every.time > given.measured.time[0]) & (every.time < given.measured.time[-1] + 1e-6))
    grid = near.grid
    shape = tuple(len(range(0, n, 2)) for n in grid.shape)
    thin = along_z(
        replace(
            near,
            grid=geometry.Grid(grid.origin, tuple(2 * s for s in grid.spacing), shape),
            velocity=near.velocity[..., ::2, ::2, ::2],
            mask=near.mask[:, ::2, ::2, ::2],
            pressure=None,
            sigma=np.full((near.frames, 3, *shape), 0.01, np.float32),
        )
    )
    both = assimilate(given.prepared, fine, coarse=given.model, members=3, also=[thin])
    used = both.info["filter"]["observations"]["used"]
    assert used > plain.info["filter"]["observations"]["used"] + 1000
    assert len(both.info["observation_error_scale"]) == 4
    assert nrmse(both.recording) < 0.93 * nrmse(plain.recording)
    with pytest.raises(ValueError, match="dimensions"):
        flat = geometry.Recording(
            time=near.time,
            grid=geometry.Grid((0.0, 0.0), (1e-3, 1e-3), (4, 4)),
            velocity=np.zeros((near.frames, 2, 4, 4)),
            mask=np.ones((4, 4), bool),
            rho=1.0,
            mu=0.0,
            wall=geometry.Wall(
                np.array([[0, 0], [3e-3, 0], [0, 3e-3]]), np.array([[0, 1], [1, 2], [2, 0]]), np.zeros(3)
            ),
        )
        given.run(also=[flat])


@pytest.mark.slow
def test_the_same_measurement_twice_adds_little(given, plain):
    """Duplicates are counted as independent; the gain learned from the innovations keeps them from being believed."""
    twice = given.run(also=[given.measured])
    assert nrmse(twice.recording) < 1.1 * nrmse(plain.recording)


def test_an_estimated_parameter_stays_in_its_bounds_and_moves(given):
    viscosity = Estimated(Parameter("viscosity", low=0.0, smallest_spread=0.1), value=0.004, spread=0.5)
    run = given.run(options=EnsembleOptions(estimated=(viscosity,)), members=4)
    found = run.info["estimated"]["viscosity"]
    assert found["mean"] > 0 and found["deviation"] > 0
    with pytest.raises(ValueError, match=r"Estimated.spread of viscosity"):
        Estimated(Parameter("viscosity"), 1.0, 0.0)


@pytest.mark.parametrize("fine", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_observations_noisier_than_said_are_noticed(given, fine):
    """The file claims a tenth of the errors, or less; with a forecast of some worth the claim costs nothing."""
    told = replace(given.measured, sigma=np.full_like(given.measured.velocity, 0.004))
    prepared = PreparedMeasurement(told, smoothed=given.smoothed)
    model = made_model(told, FINE) if fine else given.model
    run = assimilate(prepared, model, coarse=given.model, members=3, seed=1)
    assert min(run.info["observation_error_scale"]) > 4.0
    words = run.info["filter"]["warnings"]
    assert any("overconfident" in each for each in words)
    assert sum("times as noisy" in each for each in words) == 3
    if fine:
        assert nrmse(run.recording) < 1.1 * nrmse(given.smoothed)


def test_an_observation_that_claims_to_be_exact_is_refused_by_name(given):
    sigma = np.full_like(given.measured.velocity, 0.05)
    sigma[1] = 0.0
    with pytest.raises(
        geometry.RecordingError, match=r"/sigma: must be positive .* as at frame 1, .* leave /sigma out"
    ):
        PreparedMeasurement(replace(given.measured, sigma=sigma))


@pytest.mark.slow
def test_irregular_frames_and_a_valve_that_opens_between_them(given):
    """Frames of 10 and 30 ms around the opening of the mitral valve at 250 ms."""
    measured = geometry.read_recording(sample_measurement()).select([3, 4, 7, 8])
    assert np.ptp(np.diff(measured.time)) > 0.015
    opening = measured.valve_intervals_or_derived()[:, 1]
    assert ((opening > measured.time[1]) & (opening < measured.time[2])).any()
    prepared = PreparedMeasurement(measured)
    run = assimilate(prepared, made_model(measured), members=2)
    assert nrmse(run.recording) < nrmse(prepared.smoothed)


def test_the_names_are_exported():
    assert {"EnsembleOptions", "Estimated", "assimilate"} <= set(torchsph.__all__)
