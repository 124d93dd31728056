"""Observations: rules, reason codes and concatenation."""

import pytest
import torch

from torchsph.assimilation import AssimilationError, Observations, Reason, concatenate


def test_zero_variance_is_refused_and_can_be_floored():
    value = torch.zeros(3)
    with pytest.raises(AssimilationError, match=r"\[1\] is zero or negative"):
        Observations(value, torch.tensor([1.0, 0.0, 1.0]))
    floored = Observations.with_floor(value, torch.tensor([1.0, 0.0, 1.0]), 0.01)
    assert floored.variance.tolist() == pytest.approx([1.0, 0.01, 1.0])
    with pytest.raises(AssimilationError, match="floor"):
        Observations.with_floor(value, torch.ones(3), 0.0)


def test_codes_and_their_precedence():
    value = torch.tensor([1.0, torch.nan, 1.0, torch.nan])
    variance = torch.tensor([1.0, 1.0, torch.inf, 1.0])
    earlier = torch.tensor([0, 0, 0, Reason.THINNED], dtype=torch.uint8)
    codes = Observations(value, variance, reason=earlier).codes()
    assert codes.tolist() == [Reason.USED, Reason.MISSING, Reason.NO_WEIGHT, Reason.THINNED]


def test_positions_repeat_over_components():
    place = torch.tensor([[0.0, 1.0], [2.0, 3.0]])
    observations = Observations(torch.zeros(6), torch.ones(6), place)
    assert torch.equal(observations.places, place.repeat(3, 1))
    with pytest.raises(AssimilationError, match="multiple"):
        Observations(torch.zeros(5), torch.ones(5), place)


def test_concatenate_keeps_what_belongs_together():
    place = torch.tensor([[0.0], [1.0]])
    first = Observations(torch.zeros(4), torch.ones(4), place, redundancy=2.0)
    second = Observations(torch.tensor([torch.nan]), torch.tensor([2.0]), place[:1])
    both = concatenate([first, second])
    assert len(both) == 5 and both.places.flatten().tolist() == [0, 1, 0, 1, 0]
    assert both.redundancy.tolist() == [2, 2, 2, 2, 1]
    assert both.codes().tolist() == [0, 0, 0, 0, Reason.MISSING]
    assert concatenate([first, Observations(torch.zeros(1), torch.ones(1))]).position is None
    with pytest.raises(AssimilationError, match="no observations"):
        concatenate([])


def test_shapes_are_checked():
    with pytest.raises(AssimilationError, match="does not fit"):
        Observations(torch.zeros(3), torch.ones(2))
    with pytest.raises(AssimilationError, match="floating-point"):
        Observations(torch.zeros(3, dtype=torch.long), torch.ones(3))
    with pytest.raises(AssimilationError, match="redundancy"):
        Observations(torch.zeros(3), torch.ones(3), redundancy=0.5)
