"""Flow through a round pipe, driven by a body force, against the solutions of Hagen-Poiseuille and Szymanski."""

import pytest
from wall_cases import RADIUS, assert_nothing_went_wrong, axis_distance, fill_with, pipe

from torchsph import PotentialWall
from torchsph.validation import exact_wall_flows as validation_walls
from torchsph.validation.exact_flows import observed_order

VISCOSITY = 0.1
FORCE = 4 * VISCOSITY / RADIUS**2  # 1 m/s on the axis


def errors(across, times, **changes):
    """Relative L2 velocity error at ``times`` (s) after a start from rest."""
    run = pipe(across, VISCOSITY, (0.0, 0.0, FORCE), **changes)
    found = []
    for time in times:
        run.advance(time)
        exact = validation_walls.pipe_start(axis_distance(run), time, VISCOSITY, FORCE, RADIUS)
        wrong = run.particles.velocity.double()
        wrong[:, 2] -= exact
        found.append(float(wrong.norm() / exact.norm()))
    assert_nothing_went_wrong(run)
    assert float(axis_distance(run).max()) < RADIUS
    return found


def test_start_up_at_16_across():
    """The issue asks for 2 %, a peer states less than 3 % at 20 across; 0.5 % through the start-up was measured."""
    assert max(errors(16, (0.25, 0.75))) < 0.008


@pytest.mark.slow
def test_order_of_convergence():
    """At 8, 12, 16, 24 across in the steady state 1.3, 0.6, 0.4, 0.2 %: order 1.6 (1.5 asked for).

    With the default h = 1.3 the error levels off at 0.8 %: the viscous sum over 57 neighbours is 1 to 2 % too weak.
    """
    across = (8, 12, 16, 24)
    found = [errors(n, (2.0,), length=12, smoothing_ratio=1.6)[0] for n in across]
    assert found[2] < 0.006
    assert observed_order([1 / n for n in across], found) > 1.5


def test_the_thesis_wall_is_far_from_it():
    """The potential wall on the same flow, from the steady profile: 7 %, and the flow goes on slowing down."""
    run = pipe(16, VISCOSITY, (0.0, 0.0, FORCE), wall=PotentialWall(), shifting=0.5, shifting_speed="local")
    fill_with(run, validation_walls.pipe_flow(axis_distance(run), VISCOSITY, FORCE, RADIUS))
    run.advance(0.5)
    exact = validation_walls.pipe_flow(axis_distance(run), VISCOSITY, FORCE, RADIUS)
    assert 0.04 < float((run.particles.velocity[:, 2].double() - exact).norm() / exact.norm()) < 0.12
