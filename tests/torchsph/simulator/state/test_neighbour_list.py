"""Lists that are made anew member by member, and accelerations that follow particles into new rows."""

import torch

from torchsph.simulator.state.neighbour_list import PairSearch, rows_carried
from torchsph.simulator.state.particles import Particles


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


def test_accelerations_of_other_particles_are_not_carried():
    """Somebody has put in more particles than were stepped last."""
    assert rows_carried(lattice(3), lattice(3), torch.ones(4, 2)).tolist() == [[0.0, 0.0]] * 12
