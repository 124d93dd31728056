"""Particles that hang together: pieces counted by hand, per member, across periodic sides."""

import torch

from torchsph.simulator.stepping.connected_parts import components


def test_pieces_of_two_members():
    """A chain of three and a lone one; the second member has the chain cut by a particle that does not couple."""
    place = torch.tensor([[0.0, 0], [0.9, 0], [1.8, 0], [5.0, 0]] * 2, dtype=torch.float64)
    member = torch.arange(2).repeat_interleave(4)
    coupled = torch.ones(8, dtype=torch.bool)
    coupled[5] = False
    label, count = components(place, member, coupled, 1.0, None)
    assert count == 5
    assert label.tolist() == [0, 0, 0, 1, 2, 2, 3, 4]


def test_a_periodic_side_joins():
    place = torch.tensor([[0.1, 0.5], [9.9, 0.5], [5.0, 0.5]])
    member, every = torch.zeros(3, dtype=torch.int64), torch.ones(3, dtype=torch.bool)
    period = torch.tensor([10.0, float("inf")])
    assert components(place, member, every, 1.0, period)[0].tolist() == [0, 0, 1]
    assert components(place, member, every, 1.0, None)[1] == 3
