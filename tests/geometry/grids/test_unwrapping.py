"""Wrapped speeds come back: against NumPy along a line, against every choice in small fields, on exact flows."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from geometry import unwrap

LIMIT = 0.4  # m/s


def wrapped(speed: np.ndarray, limit: float = LIMIT) -> np.ndarray:
    return speed - 2 * limit * np.rint(speed / (2 * limit))


def wrong(found: np.ndarray, right: np.ndarray, known: np.ndarray, limit: float = LIMIT) -> float:
    return float((np.abs(found - right) > limit)[known].mean())


def test_along_a_line_as_numpy_does() -> None:
    place = np.linspace(0, 3, 200)
    speed = 3.3 * LIMIT * np.sin(place) ** 2 - 0.1 * place
    known, slow = np.ones(place.shape, bool), place == 0
    expected = np.unwrap(wrapped(speed), period=2 * LIMIT)
    np.testing.assert_allclose(unwrap(wrapped(speed), known, LIMIT, slow), expected, atol=1e-12)
    np.testing.assert_allclose(expected, speed, atol=1e-12)


def test_no_other_choice_of_turns_is_more_continuous() -> None:
    generator = np.random.default_rng(0)
    choices = np.array(list(product((-1, 0, 1), repeat=9))).reshape(-1, 3, 3)

    def roughness(field: np.ndarray) -> np.ndarray:
        return sum(np.abs(np.diff(field, axis=axis)).sum((-2, -1)) for axis in (-2, -1))

    for _ in range(20):
        speed = LIMIT * generator.uniform(-1, 1, (3, 3))
        found = unwrap(speed, np.ones((3, 3), bool), LIMIT)
        least = roughness(speed + 2 * LIMIT * choices).min()
        assert roughness(found) <= least * 1.02 + 1e-9  # the pull towards rest is worth a hundredth of a turn
        assert np.allclose(np.rint((found - speed) / (2 * LIMIT)) * 2 * LIMIT, found - speed)


def pipe(nodes: int, peak: float) -> tuple[np.ndarray, np.ndarray]:
    """Poiseuille flow through a pipe along the last axis but one of a grid, and the nodes inside."""
    x = np.linspace(-1, 1, nodes)
    distance = np.hypot(x[:, None, None], x[None, None, :]) * np.ones((1, 6, 1))
    return peak * (1 - distance**2), distance < 1


def vortex(nodes: int, peak: float) -> tuple[np.ndarray, np.ndarray]:
    """Speed along y of the vortex of Lamb and Oseen, whose highest is `peak`."""
    x, y = np.meshgrid(np.linspace(-4, 4, nodes), np.linspace(-4, 4, nodes))
    square = x**2 + y**2
    around = (1 - np.exp(-1.25643 * square)) / np.maximum(square, 1e-12) * x / 0.7153
    return peak * around, square < 16


def jet(nodes: int, peak: float) -> tuple[np.ndarray, np.ndarray]:
    """The plane jet of Bickley, u = sech^2(y / d(x)), which widens."""
    x, y = np.meshgrid(np.linspace(1, 3, nodes), np.linspace(-4, 4, nodes))
    return peak * x ** (-1 / 3) / np.cosh(y * x ** (-2 / 3)) ** 2, np.abs(y) < 4


def edge(known: np.ndarray) -> np.ndarray:
    return known & ~binary_erosion(known, border_value=1)


FLOWS = {"pipe": pipe, "vortex": vortex, "jet": jet}


@pytest.mark.parametrize("flow", FLOWS)
@pytest.mark.parametrize("ratio", [1.2, 2.1, 3.5])
def test_exact_flows_come_back(flow: str, ratio: float) -> None:
    speed, known = FLOWS[flow](33, ratio * LIMIT)
    assert wrong(wrapped(speed), speed, known) > 0.005
    found = unwrap(wrapped(speed), known, LIMIT, edge(known))
    np.testing.assert_allclose(found[known], speed[known], atol=1e-9)


@pytest.mark.parametrize("flow", FLOWS)
def test_noise_of_a_fifth_of_the_limit_leaves_less_than_one_per_cent(flow: str) -> None:
    speed, known = FLOWS[flow](33, 2.1 * LIMIT)
    noise = 0.2 * LIMIT * np.random.default_rng(1).standard_normal(speed.shape)
    measured, slow = wrapped(speed + noise), edge(known)
    known &= np.random.default_rng(2).random(speed.shape) > 0.1  # nodes without data among them
    before = wrong(measured, speed + noise, known)
    assert before > 0.04
    assert wrong(unwrap(measured, known, LIMIT, slow), speed + noise, known) < 0.01


def test_what_has_not_wrapped_stays_as_it_is_to_the_bit() -> None:
    speed, known = vortex(33, 0.9 * LIMIT)
    np.testing.assert_array_equal(unwrap(speed, known, LIMIT), speed)
    known[:, 10:20] = False  # two islands
    np.testing.assert_array_equal(unwrap(speed, known, LIMIT), speed)
    silent = np.full(known.shape, np.nan)
    assert np.isnan(unwrap(silent, np.zeros(known.shape, bool), LIMIT)).all()


def test_refusals() -> None:
    speed = np.zeros((3, 4))
    with pytest.raises(ValueError, match=r"speed has the shape \(3, 4\), but known \(3,\)"):
        unwrap(speed, np.ones(3, bool), LIMIT)
    for limit in (0.0, -1.0, np.inf):
        with pytest.raises(ValueError, match="limit must be"):
            unwrap(speed, np.ones((3, 4), bool), limit)
