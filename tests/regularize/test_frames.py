"""Solving one frame with another's factor, and many right-hand sides at once."""

import pytest
import torch
from regularize_cases import smoother

from regularize import InvalidInput, NotConverged, PreparedSystem, pcg
from regularize.smoothing.knot_grid import knots_for
from regularize.smoothing.row_blocks import build_system
from regularize.smoothing.samples import FitData

OPTIONS = smoother(automatic=None, robust=None, divergence=10e-3)
BOX = ((0.0, 0.0, 0.0), (12e-3, 12e-3, 15e-3))


def frame(seed, n=900, radius=5.5e-3):
    """Samples in a ball; frames differ in positions, weights and values, and a little in extent."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    direction /= direction.norm(dim=1, keepdim=True)
    points = radius * direction * torch.rand(n, 1, generator=generator, dtype=torch.float64) ** (1 / 3)
    points = points + torch.tensor([6e-3, 6e-3, 7e-3], dtype=torch.float64)
    x, y, z = (200 * points).unbind(1)
    velocity = torch.stack([torch.sin(y + 0.1 * seed), torch.cos(z), torch.sin(x)], dim=1)
    weight = torch.rand(n, generator=generator, dtype=torch.float64) + 0.2
    return points, velocity, weight


def test_neighbouring_factor_gives_the_direct_solution_in_few_iterations():
    options = OPTIONS.fixed(solver="pcg", tolerance=1e-9)
    points, velocity, weight = frame(0)
    first = options.fit(points, velocity, weight, box=BOX)
    changed = weight * (0.7 + 0.6 * torch.rand(len(weight), generator=torch.Generator().manual_seed(5)))
    second = options.fit(points, -velocity, changed, box=BOX, neighbour=first)
    direct = OPTIONS.fit(points, -velocity, changed, box=BOX)
    assert second.solution.solver == "pcg" and 0 < second.solution.iterations < 25
    assert second.solution.gradient <= 1e-9
    assert torch.allclose(second.coefficients, direct.coefficients, atol=1e-5)
    third = options.fit(points, velocity, weight, box=BOX, neighbour=second)  # the factor is handed on
    assert torch.allclose(third.coefficients, first.coefficients, atol=1e-5)


def test_neighbour_too_different_is_solved_directly_and_says_so():
    options = OPTIONS.fixed(solver="pcg", tolerance=1e-9)
    first = options.fit(*frame(0), box=BOX)
    second = options.fit(*frame(1, radius=5.8e-3), box=BOX, neighbour=first)
    assert second.solution.solver == "direct" and second.solution.gradient <= 1e-9
    direct = OPTIONS.fit(*frame(1, radius=5.8e-3), box=BOX)
    assert torch.allclose(second.coefficients, direct.coefficients, atol=1e-8)


def test_neighbour_without_a_factor_or_on_other_knots_is_refused():
    options = OPTIONS.fixed(solver="pcg")
    with pytest.raises(InvalidInput, match="neighbour"):
        options.fit(*frame(1), box=BOX, neighbour=OPTIONS.fit(*frame(0), box=BOX))
    with pytest.raises(InvalidInput, match="neighbour"):
        options.fit(*frame(1), box=BOX, neighbour=options.fit(*frame(0)))


def test_pcg_reports_non_convergence():
    systems = []
    for seed in (0, 1):
        data = FitData.checked(*frame(seed), None, None, BOX, 1.0)
        systems.append(PreparedSystem(build_system(OPTIONS, knots_for(data, OPTIONS), data)))
    with pytest.raises(NotConverged, match="solve directly"):
        pcg(systems[1], systems[0].factor(), tolerance=1e-12, max_iterations=2)


def test_many_right_hand_sides_equal_single_fits():
    points, velocity, weight = frame(0)
    members = torch.stack([velocity, 2 * velocity, velocity.flip(1)])
    fields = OPTIONS.fit_many(points, members, weight)
    for member, field in zip(members, fields, strict=True):
        single = OPTIONS.fit(points, member, weight)
        assert torch.allclose(field.coefficients, single.coefficients, atol=1e-10)
        assert field.solution.gradient < 1e-9


def test_many_right_hand_sides_with_automatic_choice_share_it():
    points, velocity, weight = frame(0)
    fields = smoother().fit_many(points, torch.stack([velocity, 1.1 * velocity]), weight)
    assert fields[0].choice is fields[1].choice and fields[0].choice.curvature > 0
    with pytest.raises(InvalidInput, match="velocities"):
        smoother().fit_many(points, velocity, weight)


def test_another_frames_choice_is_taken_over_but_outliers_are_judged_anew():
    points, velocity, weight = frame(0)
    noise = 0.1 * torch.randn(velocity.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    first = smoother().fit(points, velocity + noise, weight)
    spoilt = velocity - noise
    spoilt[5] += 10.0
    second = smoother().fit(points, spoilt, weight, choice=first.choice)
    assert second.choice.noise == first.choice.noise and second.choice.curvature == first.choice.curvature
    assert float(second.choice.robust[5]) == 0 and float(first.choice.robust[5]) > 0
    assert float((second(points) - velocity).square().mean().sqrt()) < 0.06


def test_float32_factor_gives_the_direct_field():
    points, velocity, weight = frame(0)
    direct = OPTIONS.fit(points, velocity, weight)
    single = OPTIONS.fixed(solver="direct32", tolerance=1e-9).fit(points, velocity, weight)
    assert single.solution.gradient <= 1e-9 and single.solution.gradient != direct.solution.gradient
    assert torch.allclose(single.coefficients, direct.coefficients, atol=1e-5)
    with pytest.raises(InvalidInput, match="uncertainty"):
        OPTIONS.fixed(solver="direct32").fit(points, velocity, weight, uncertainty=True)
