"""Every registered linear solver solves the same systems; a solver added to the registry is tested here by itself."""

from dataclasses import replace

import pytest
import torch
from regularize_cases import AXES, dense_of, system_of

from regularize import InvalidInput, NotConverged, Smoother
from regularize.options import AUTO
from regularize.solvers.interface import Limits, Neighbour
from regularize.solvers.registry import SOLVERS

TIGHT = Limits(tolerance=1e-9, max_iterations=20000)
every_solver = pytest.mark.parametrize("name", SOLVERS)


def dense_solution(system):
    """By orthogonal transformations of the stacked rows, not by the normal equations that solvers form."""
    damped = torch.cat([dense_of(system), system.damping * torch.eye(system.unknowns, dtype=torch.float64)])
    right = torch.cat([system.target(), torch.zeros(system.unknowns, dtype=torch.float64)])
    return torch.linalg.lstsq(damped, right, driver="gelsd").solution


@every_solver
@pytest.mark.parametrize("axes", AXES)
def test_equals_dense_least_squares(name, axes):
    system = system_of(axes, damping=0.3)
    solution = SOLVERS[name].solve(system, TIGHT).solution
    expected = dense_solution(system)
    assert torch.allclose(solution.x.double(), expected, atol=1e-6 * float(expected.abs().max()))
    assert solution.gradient <= TIGHT.tolerance and solution.solver and solution.reason


@every_solver
def test_the_gradient_that_it_states_is_the_true_one(name):
    system = system_of(2, damping=0.3)
    solution = SOLVERS[name].solve(system, Limits(tolerance=1e-4)).solution
    true = float(system.gradient(solution.x).norm() / system.right_side().norm())
    assert solution.gradient == pytest.approx(true, rel=1e-3, abs=1e-13)


@every_solver
def test_untouched_coefficients_stay_zero(name):
    system = system_of(2, damping=0.3, beyond=6.0)
    x = SOLVERS[name].solve(system, TIGHT).solution.x.view(system.knots.nodes, -1)
    assert not bool(x[~system.touched()].any()) and bool(x[system.touched()].any())


@every_solver
def test_a_right_side_of_zeros_gives_zero(name):
    system = system_of(2, damping=0.3)
    for block in system.blocks:
        block.target = torch.zeros_like(block.target)
    solution = SOLVERS[name].solve(system, Limits()).solution
    assert float(solution.x.abs().max()) == 0 and solution.gradient == 0


@every_solver
def test_a_tolerance_out_of_reach_is_said_when_strict_and_stated_when_not(name):
    system = system_of(2, damping=0.3)
    out_of_reach = Limits(tolerance=1e-30, max_iterations=3)
    with pytest.raises(NotConverged) as caught:
        SOLVERS[name].solve(system, out_of_reach)
    loose = SOLVERS[name].solve(system, replace(out_of_reach, strict=False)).solution
    assert loose.gradient == caught.value.solution.gradient > 1e-30


@every_solver
def test_a_factor_that_it_calls_its_own_is_that_of_the_normal_matrix(name):
    system = system_of(2, damping=0.3)
    factor = SOLVERS[name].solve(system, TIGHT).factor
    if not SOLVERS[name].factors:
        return
    a = dense_of(system).view(-1, system.knots.nodes, system.components)[:, factor.ordering.nodes].flatten(1)
    normal = a.T @ a + system.damping**2 * torch.eye(a.shape[1], dtype=torch.float64)
    assert factor.log_determinant() == pytest.approx(float(torch.linalg.slogdet(normal)[1]), rel=1e-10)
    right = torch.ones(len(factor.ordering.nodes), system.components, dtype=torch.float64)
    assert torch.allclose(normal @ factor.solve(right).flatten(), right.flatten(), atol=1e-9)


@every_solver
def test_a_neighbour_changes_the_work_and_not_the_answer(name):
    system, other = system_of(2, damping=0.3), system_of(2, damping=0.33)
    first = SOLVERS["direct"].solve(other, TIGHT)
    start = Neighbour(other.knots, first.solution.x.view(other.knots.nodes, -1), first.factor)
    solution = SOLVERS[name].solve(system, TIGHT, start).solution
    expected = dense_solution(system)
    assert torch.allclose(solution.x.double(), expected, atol=1e-6 * float(expected.abs().max()))
    if SOLVERS[name].starts_from_neighbour:
        with pytest.raises(InvalidInput, match="neighbour holds no factor"):
            SOLVERS[name].solve(system, TIGHT, replace(start, factor=None))


@every_solver
@pytest.mark.parametrize("stored", [False, True])
def test_stored_rows_change_nothing(name, stored):
    system = system_of(2, damping=0.3)
    solution = SOLVERS[name].solve(system, replace(TIGHT, stored=stored)).solution
    expected = dense_solution(system)
    assert torch.allclose(solution.x.double(), expected, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.parametrize("name", [AUTO, *SOLVERS])
def test_the_smoother_takes_it_by_name(name):
    generator = torch.Generator().manual_seed(5)
    points = 0.01 * torch.rand(400, 2, generator=generator, dtype=torch.float64)
    velocity = torch.sin(300 * points)
    options = Smoother(knots=3e-3, curvature=3e-4, damping=1e-2, tolerance=1e-8).fixed()
    found = replace(options, solver=name).fit(points, velocity)(points)
    assert torch.allclose(found, options.fit(points, velocity)(points), atol=1e-6)
