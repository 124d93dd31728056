"""A member's bits depend on itself alone: not on its company in a batch, nor on the number of threads."""

import numpy as np
import pytest
import torch

import geometry
from torchsph import Scene, Simulator, preset
from torchsph.simulator import spatial_sort
from torchsph.simulator.state.neighbour_list import PairSearch, rows_carried
from torchsph.simulator.state.particles import Particles

START, STOP = 0.30, 0.306  # s, in the filling


@pytest.fixture(scope="module")
def recording():
    return geometry.Ventricle().recording(np.arange(0.0, 0.4401, 0.01), grid_spacing=3e-3, wall_spacing=3e-3)


@pytest.fixture(scope="module")
def scene(recording):
    return Scene.from_recording(recording, 3e-3)


def filled(scene, recording, name, members):
    """Runs of some of three members that differ in speed and turbulence, over a stretch of the filling."""
    draw = np.random.default_rng(0)
    shape = recording.velocity.shape[1:]
    noise = draw.normal(0.0, 0.1, (3, *shape)).astype(np.float32)
    factor = np.array([0.5, 1.0, 2.5], np.float32)[:, None, None, None, None]
    field = torch.from_numpy((factor * (recording.velocity[30] + noise))[list(members)])
    run = Simulator(scene, preset(name)).start(START, members=len(members), seed=3)
    run.impose(recording.grid, field, torch.from_numpy(np.array(recording.mask[30])))
    run.advance(0.5 * (START + STOP))
    run.advance(STOP)
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
def test_bits_do_not_depend_on_the_number_of_threads(scene, recording, name):
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(filled(scene, recording, name, (0, 2)).particles)
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert torch.equal(other.position, found[0].position) and torch.equal(other.velocity, found[0].velocity)


class Listing:
    """A backend that remembers for which places it made its lists."""

    def __init__(self):
        self.places = []

    def search(self, position, member, radius, *, margin, period):
        self.places.append(position)
        return len(self.places)


def lattice(members, count=4):
    place = torch.arange(members * count, dtype=torch.float64)[:, None] * torch.ones(1, 2, dtype=torch.float64)
    one, zero = torch.ones(members * count), torch.zeros(members * count, dtype=torch.int64)
    return Particles(place, 0 * place, 0 * one, one, torch.arange(members).repeat_interleave(count), zero, members)


def test_only_members_that_moved_are_listed_anew():
    search, first = PairSearch(Listing(), 2.0, 0.25), lattice(2)
    assert search.at(first) == 1
    little = first.changed(position=first.position + 0.01)
    assert search.at(little) == 1
    moved = little.changed(position=little.position + (little.member == 1)[:, None])
    assert search.at(moved) == 2
    assert torch.equal(
        search.backend.places[1], torch.where(moved.member[:, None] == 1, moved.position, first.position)
    )
    assert search.renewed.tolist() == [1, 2] and search.searches == 2


def test_a_member_that_grows_leaves_the_lists_of_the_others():
    search, first = PairSearch(Listing(), 2.0, 0.25), lattice(3)
    search.at(first)
    shifted = first.changed(position=first.position + 0.01)
    grown = shifted.joined(shifted.select(torch.tensor([5])))  # of member 1, at the end
    assert search.at(grown) == 2
    kept = grown.member != 1
    assert torch.equal(search.backend.places[1][kept], first.position[first.member != 1])
    assert torch.equal(search.backend.places[1][~kept], grown.position[~kept])


def test_accelerations_are_carried_where_nothing_changed():
    first = lattice(3)
    values = torch.arange(24.0, dtype=torch.float64).reshape(12, 2)
    fewer = first.select(torch.arange(12) != 5)  # one of member 1
    carried = rows_carried(first, fewer, values)
    assert torch.equal(carried[fewer.member == 0], values[:4]) and torch.equal(carried[fewer.member == 2], values[8:])
    assert not bool(carried[fewer.member == 1].any())
    swapped = first.select(torch.tensor([1, 0, *range(2, 12)]))  # as many, elsewhere
    assert not bool(rows_carried(first, swapped, values)[:4].any())
