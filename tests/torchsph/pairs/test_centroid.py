"""The centroid form of XSPH where its sum is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from pair_cases import disordered, support

from torchsph.pairs import RateTerms, ReferenceBackend
from torchsph.pairs.centroid import centroid_xsph


def lattice(dimension: int, side: int = 6):
    """Unit masses in the middles of unit cells, with random velocities."""
    state = disordered(side, dimension)
    position = torch.cartesian_prod(*[torch.arange(side, dtype=torch.float64) + 0.5] * dimension)
    return dataclasses.replace(
        state, position=position, mass=torch.ones_like(state.mass), deviation=torch.zeros_like(state.mass)
    )


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("periodic", [False, True])
def test_one_particle_in_the_middle_of_each_cell_gives_the_full_sum(dimension, periodic):
    state, choice = lattice(dimension), support("wendland_c2", dimension, 0.7)
    period = torch.full((dimension,), 6.0, dtype=torch.float64) if periodic else None
    if not periodic:  # cells begin at the lowest coordinate: one particle there puts the others in the middle
        corner = dataclasses.replace(
            state,
            **{k: v[:1] for k, v in vars(state).items()} | {"position": torch.zeros(1, dimension).double()},
        )
        weightless = dataclasses.replace(corner, mass=torch.full((1,), 1e-30, dtype=torch.float64))
        parts = zip(vars(state).items(), vars(weightless).values(), strict=True)
        state = dataclasses.replace(state, **{k: torch.cat([v, w]) for (k, v), w in parts})
    engine = ReferenceBackend()
    pairs = engine.search(state.position, state.member, choice.radius, period=period)
    full = engine.rates(pairs, state, choice, RateTerms(None, xsph=True)).xsph
    got = centroid_xsph(state, choice, 1.0, period)
    number = 6**dimension
    np.testing.assert_allclose(got[:number].numpy(), full[:number].numpy(), atol=1e-12)


@pytest.mark.parametrize("dimension", [2, 3])
def test_uniform_motion_is_left_alone(dimension):
    state = disordered(7, dimension, members=2)
    state = dataclasses.replace(state, velocity=torch.ones_like(state.velocity) * state.member[:, None])
    got = centroid_xsph(state, support("cubic", dimension), 2.4)
    assert float(got.abs().max()) < 1e-13


def test_cell_edge_must_be_positive():
    with pytest.raises(ValueError, match="must be positive"):
        centroid_xsph(disordered(3, 2), support("cubic", 2), 0.0)
