"""What a member's bits do not depend on: the order in which runs are stepped, its batch, the number of threads."""

import numpy as np
import pytest
import torch

import geometry
from torchsph import Scene, Simulator, preset
from torchsph.simulator import spatial_sort

STEP = 1e-3  # s


FILLING = (0.30, 0.306)  # s
EJECTION = (0.19, 0.22)  # s: the openings go on from place to place, and the outlet shuts at 0.21


@pytest.fixture(scope="module")
def recording():
    return geometry.Ventricle().recording(np.arange(0.0, 0.4401, 0.01), grid_spacing=3e-3, wall_spacing=3e-3)


@pytest.fixture(scope="module")
def scene(recording):
    return Scene.from_recording(recording, 3e-3)


def advanced(run, start, number):
    run.advance(start + number * STEP)
    if run.can_project:  # enters an interval of its own
        run.project()


@pytest.mark.parametrize("name", ["default", "weakly_compressible", pytest.param("thesis", marks=pytest.mark.slow)])
def test_two_runs_in_turns_give_the_bits_of_each_alone(scene, name):
    """One fills while the other ejects, so that walls, open valves and buffers differ all the time."""
    starts = (0.30, 0.09)
    shared = Simulator(scene, preset(name))
    together = [shared.start(start, seed=1) for start in starts]
    for number in (1, 2, 3):
        for run, start in zip(together, starts, strict=True):
            advanced(run, start, number)
    for run, start in zip(together, starts, strict=True):
        alone = Simulator(scene, preset(name)).start(start, seed=1)
        for number in (1, 2, 3):
            advanced(alone, start, number)
        assert torch.equal(run.particles.position, alone.particles.position)
        assert torch.equal(run.particles.velocity, alone.particles.velocity)
        assert repr(run.record.summary()) == repr(alone.record.summary())
        assert int(run.record.steps) > 2 and not bool(run.record.failed)


def filled(scene, recording, name, members, span=FILLING):
    """Runs of some of three members that differ in speed and turbulence, over a stretch of the filling (s)."""
    draw = np.random.default_rng(0)
    shape = recording.velocity.shape[1:]
    noise = draw.normal(0.0, 0.1, (3, *shape)).astype(np.float32)
    factor = np.array([0.5, 1.0, 2.5], np.float32)[:, None, None, None, None]
    frame = int(np.searchsorted(recording.time, span[0] - 1e-9))
    field = torch.from_numpy((factor * (recording.velocity[frame] + noise))[list(members)])
    run = Simulator(scene, preset(name)).start(span[0], members=len(members), seed=3)
    run.impose(recording.grid, field, torch.from_numpy(np.array(recording.mask[frame])))
    run.advance(0.5 * sum(span))
    run.advance(span[1])
    assert not bool(run.record.failed.any())
    return run


def rows_of(run, member):
    mine = run.particles.member == member
    return [getattr(run.particles, name)[mine] for name in ("position", "velocity", "deviation")]


@pytest.mark.parametrize(
    ("name", "sort_from"), [("default", 50_000), ("weakly_compressible", 50_000), ("weakly_compressible", 1)]
)
def test_a_member_has_the_bits_it_has_alone(scene, recording, name, sort_from, monkeypatch):
    """Faster members have their neighbours searched more often, and blood comes in at other moments."""
    monkeypatch.setattr(spatial_sort, "_SORT_FROM", sort_from)
    monkeypatch.setattr(spatial_sort, "_SORT_EVERY", 2)
    batch = filled(scene, recording, name, (0, 1, 2))
    for member in (0, 2):
        alone = filled(scene, recording, name, (member,))
        for together, single in zip(rows_of(batch, member), rows_of(alone, 0), strict=True):
            assert torch.equal(together, single)


@pytest.mark.parametrize("name", ["default", "weakly_compressible"])
def test_a_member_sees_the_openings_of_its_own_time(scene, recording, name):
    """Members are at other times of an interval, so that some see an opening's earlier place and some the next."""
    batch = filled(scene, recording, name, (0, 1, 2), EJECTION)
    assert name == "default" or len(set(batch.record.steps.tolist())) > 1
    for member in range(3):
        alone = filled(scene, recording, name, (member,), EJECTION)
        for together, single in zip(rows_of(batch, member), rows_of(alone, 0), strict=True):
            assert torch.equal(together, single)
        for account in ("inserted", "removed", "inflow", "outflow", "energy_out"):
            assert torch.equal(getattr(batch.record, account)[member], getattr(alone.record, account)[0])


@pytest.mark.parametrize("name", ["default", "weakly_compressible"])
def test_bits_do_not_depend_on_the_number_of_threads(scene, recording, name):
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(filled(scene, recording, name, (0, 2)).particles)
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert torch.equal(other.position, found[0].position) and torch.equal(other.velocity, found[0].velocity)
