"""The compiled passes of complete-kernel walls against torch's formulas, and the formulas where nothing is compiled."""

from dataclasses import replace

import pytest
import torch

from torchsph.native.library import LibraryMissing, library
from torchsph.pairs.interface import PRESSURE_FORMS
from torchsph.simulator.walls.compiled import complete_forces, complete_rates, near_wall
from torchsph.simulator.walls.interface import CompleteWallSample

COUNT, MEMBERS = 37, 2


def sample(dimension, dtype, sliding):
    """Walls at random: rows as the look-up gives them, and the same as columns."""
    generator = torch.Generator().manual_seed(dimension)
    rows = torch.randn((COUNT, 2 + 3 * dimension + sliding), generator=generator, dtype=torch.float64).to(dtype)
    rows[:, 1 : 1 + dimension] = torch.nn.functional.normalize(rows[:, 1 : 1 + dimension], dim=1)
    rows[:, 1 + 2 * dimension] = torch.rand(COUNT, generator=generator, dtype=torch.float64).to(dtype)
    columns = torch.split(rows, [1, dimension, dimension, 1, dimension, *([1] if sliding else [])], 1)
    flat = [c if c.shape[1] > 1 and n not in (0, 3, 5) else c[:, 0] for n, c in enumerate(columns)]
    return CompleteWallSample(*flat, *([] if sliding else [None]), rows)


@pytest.fixture(params=[(2, torch.float32, False), (3, torch.float32, True), (3, torch.float64, False)])
def case(request):
    try:
        library()
    except LibraryMissing as reason:
        pytest.skip(str(reason))
    dimension, dtype, sliding = request.param
    generator = torch.Generator().manual_seed(9)

    def normal(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)

    wall = sample(dimension, dtype, sliding)
    member = torch.randint(MEMBERS, (COUNT,), generator=generator)
    return wall, replace(wall, rows=None), normal, member, dimension


def test_rates_and_forces_are_those_of_the_formulas(case):
    wall, plain, normal, member, dimension = case
    divergence, gradient, velocity = normal(COUNT), normal(COUNT, dimension), normal(COUNT, dimension)
    for given in (gradient, None):
        torch.testing.assert_close(
            complete_rates(divergence, given, velocity, wall), complete_rates(divergence, given, velocity, plain)
        )
    pressure, deviation = normal(COUNT), 0.1 * normal(COUNT)
    for form in PRESSURE_FORMS:
        for viscosity in (None, 0.3, torch.tensor([0.1, 0.4], dtype=pressure.dtype)):
            for pressed in ({}, {"pressure": pressure, "deviation": deviation}):
                options = {"viscosity": viscosity, "member": member, "form": form, **pressed}
                got = complete_forces(gradient, velocity, wall, **options)
                torch.testing.assert_close(got, complete_forces(gradient, velocity, plain, **options))


def test_particles_near_a_wall_are_found_with_their_distance(case):
    wall, plain, normal, member, dimension = case
    before, path = normal(COUNT, dimension), 0.2 * normal(COUNT, dimension)
    step, stopped = torch.tensor([0.1, 0.0], dtype=before.dtype), normal(COUNT) > -1.0
    shifted = [replace(w, distance=w.distance - 0.1) for w in (wall, plain)]  # a distance that is not the row's
    got, wanted = (near_wall(before, before + path, w, step, member, stopped, 0.2) for w in shifted)
    assert 5 < len(wanted[0]) < COUNT
    torch.testing.assert_close(got, wanted)


def test_gradients_take_the_formulas(case):
    wall, plain, normal, _, dimension = case
    velocity = normal(COUNT, dimension).requires_grad_()
    whole, _ = complete_rates(normal(COUNT), None, velocity, wall)
    whole.sum().backward()
    by_rows = velocity.grad.clone()
    velocity.grad = None
    complete_rates(normal(COUNT), None, velocity, plain)[0].sum().backward()
    torch.testing.assert_close(by_rows, velocity.grad)
