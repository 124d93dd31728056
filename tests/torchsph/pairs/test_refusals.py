"""Arrays that compiled code must not be given: each is refused by name, and nothing is read or written beyond it."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from pair_cases import disordered, support

from torchsph.pairs import MomentumTerms, RateTerms, available_backends, choose_backend

CPU = next(status for status in available_backends() if status.name == "cpu")
pytestmark = pytest.mark.skipif(not CPU.present, reason=CPU.reason)
SUPPORT = support("wendland_c2", 3)
STATE = disordered(5, 3, members=2)
COUNT = STATE.position.shape[0]


def found():
    backend = choose_backend("cpu")
    return backend, backend.search(STATE.position, STATE.member, SUPPORT.radius)


@pytest.mark.parametrize("length", [0, 3, COUNT + 1])
@pytest.mark.parametrize("name", ["velocity", "mass", "deviation", "pressure", "slope"])
def test_arrays_of_other_lengths(name, length):
    backend, pairs = found()
    array = getattr(STATE, name)
    other = array.new_zeros((length, *array.shape[1:]))
    with pytest.raises(ValueError, match=f"the state's {name} must have the shape"):
        changed = dataclasses.replace(STATE, **{name: other})
        backend.rates(pairs, changed, SUPPORT, RateTerms(corrected_diffusion=True))
        backend.momentum(pairs, changed, SUPPORT, MomentumTerms())


def test_a_state_of_another_dimension():
    backend, pairs = found()
    plane = dataclasses.replace(STATE, position=STATE.position[:, :2], velocity=STATE.velocity[:, :2])
    with pytest.raises(ValueError, match="position must have the shape"):
        backend.rates(pairs, plane, support("wendland_c2", 2), RateTerms())


@pytest.mark.parametrize(
    ("position", "member", "error", "says"),
    [
        (STATE.position[:, :0], STATE.member, ValueError, r"\(N, 2\) or \(N, 3\)"),
        (STATE.position[:, :1], STATE.member, ValueError, r"\(N, 2\) or \(N, 3\)"),
        (STATE.position[:, 0], STATE.member, ValueError, r"\(N, 2\) or \(N, 3\)"),
        (STATE.position, STATE.member.int(), TypeError, "member must be of torch.int64"),
        (STATE.position, STATE.member.double(), TypeError, "member must be of torch.int64"),
        (STATE.position, STATE.member[:0], ValueError, "member must have the shape"),
        (STATE.position, STATE.member + 2**40, ValueError, "number the members from 0 on"),
        (STATE.position, STATE.member - 1, ValueError, "members are negative"),
    ],
)
def test_searches(position, member, error, says):
    with pytest.raises(error, match=says):
        choose_backend("cpu").search(position, member, SUPPORT.radius)


def test_a_period_of_another_dimension():
    with pytest.raises(ValueError, match="period must have the shape"):
        choose_backend("cpu").search(STATE.position, STATE.member, SUPPORT.radius, period=torch.full((2,), 9.0))


@pytest.mark.parametrize(
    ("changed", "error", "says"),
    [
        ({"group": STATE.member + 10**6}, ValueError, "groups from 1000000 to 1000001, but `singular` is of 2"),
        ({"group": STATE.member - 1}, ValueError, "groups from -1"),
        ({"group": STATE.member[1:]}, ValueError, "group must have the shape"),
        ({"group": STATE.member.int()}, TypeError, "group must be of torch.int64"),
        ({"singular": torch.ones(1, dtype=torch.bool)}, ValueError, "groups from 0 to 1, but `singular` is of 1"),
        ({"singular": torch.ones(2)}, TypeError, "singular must be of torch.bool"),
        ({"source": STATE.mass[:0]}, ValueError, "the field must have the shape"),
        ({"start": STATE.mass[:5]}, ValueError, "start must have the shape"),
        ({"free": torch.ones(0, dtype=torch.bool)}, ValueError, "free must have the shape"),
        ({"free": STATE.mass}, TypeError, "free must be of torch.bool"),
        ({"active": torch.ones(7, dtype=torch.bool)}, ValueError, "active must have the shape"),
    ],
)
def test_poisson(changed, error, says):
    backend, pairs = found()
    every = torch.ones(COUNT, dtype=torch.bool)
    given = {"source": STATE.pressure, "start": None, "free": every, "active": every, "group": None}
    given |= {"singular": torch.ones(2, dtype=torch.bool), "tolerance": 1e-3, "iterations": 5}
    with pytest.raises(error, match=says):
        backend.poisson(pairs, STATE, SUPPORT, **(given | changed))


@pytest.mark.parametrize(
    ("changed", "error", "says"),
    [
        ({"query": torch.rand(9, 2, dtype=torch.float64)}, ValueError, "query must have the shape"),
        ({"query_member": STATE.member[:0]}, ValueError, "query_member must have the shape"),
        ({"query_member": STATE.member[:9] + 2**40}, ValueError, "query_member says"),
        ({"fields": STATE.velocity[:0]}, ValueError, "fields must have the shape"),
        ({"fields": STATE.mass}, ValueError, "fields must have the shape"),
        ({"member": STATE.member[1:]}, ValueError, "member must have the shape"),
        ({"weight": STATE.mass[1:]}, ValueError, "weight must have the shape"),
    ],
)
def test_interpolation(changed, error, says):
    given = {"position": STATE.position, "member": STATE.member, "fields": STATE.velocity, "support": SUPPORT}
    given |= {"query": STATE.position[:9] + 0.1, "query_member": STATE.member[:9]}
    with pytest.raises(error, match=says):
        choose_backend("cpu").interpolate(**(given | changed))


def test_a_field_of_another_length():
    backend, pairs = found()
    with pytest.raises(ValueError, match="the field must have the shape"):
        backend.laplacian(pairs, STATE, SUPPORT, STATE.mass[:4])
    with pytest.raises(TypeError, match="active must be of torch.bool"):
        backend.laplacian(pairs, STATE, SUPPORT, STATE.mass, STATE.mass)
