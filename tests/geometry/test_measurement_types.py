"""What every type of measurement owes: its components, projections and rows tell one story."""

import numpy as np
import pytest
import torch

import geometry
from geometry.recordings.measurement_types import MEASUREMENT_TYPES, AlongBeam, Components, FullVectors, WithinPlanes

FRAMES, SHAPE = 3, (4, 5, 6)


def unit_vectors(*frames: int) -> np.ndarray:
    vectors = np.random.default_rng(0).standard_normal((*frames, 3, *SHAPE))
    return (vectors / np.linalg.norm(vectors, axis=-4, keepdims=True)).astype(np.float32)


MEASURED = {
    "full vectors": FullVectors(3),
    "one beam for all frames": AlongBeam(unit_vectors(), 3),
    "a beam that moves": AlongBeam(unit_vectors(FRAMES), 3),
    "planes for all frames": WithinPlanes(unit_vectors()),
    "planes that move": WithinPlanes(unit_vectors(FRAMES)),
}


@pytest.fixture(params=MEASURED)
def kind(request):
    return MEASURED[request.param]


@pytest.fixture(scope="module")
def velocity():
    return np.random.default_rng(1).standard_normal((FRAMES, 3, *SHAPE))


def test_every_type_is_in_the_list():
    assert {type(kind) for kind in MEASURED.values()} == set(MEASUREMENT_TYPES)


def test_projected_twice_is_projected_once_and_keeps_the_components(kind, velocity):
    once = kind.projected(velocity)
    assert once.shape == velocity.shape and kind.components(velocity).shape == (FRAMES, kind.parts, *SHAPE)
    np.testing.assert_allclose(kind.projected(once), once, atol=1e-6)
    np.testing.assert_allclose(kind.components(once), kind.components(velocity), atol=1e-6)


def test_places_see_what_the_grid_sees(kind, velocity):
    node = torch.tensor([0, 17, 60, 119])
    for frame, field in enumerate(velocity):
        seen = kind.at(frame, node)
        vectors = torch.from_numpy(field).flatten(1)[:, node]
        expected = torch.from_numpy(kind.components(velocity)[frame]).flatten(1)[:, node]
        found = seen.of(vectors.expand(2, -1, -1))  # leading dimensions pass through
        torch.testing.assert_close(found, expected.expand(2, -1, -1))
        torch.testing.assert_close((vectors.T * seen.directions).sum(-1), expected)
        ones = torch.ones(kind.parts, 4, dtype=torch.float64)
        torch.testing.assert_close(seen.directions.norm(dim=-1), ones, rtol=1e-6, atol=0)
        assert seen.variance(torch.ones(3, 4)).shape == (kind.parts, 4)


def test_the_rows_of_a_spline_are_the_numbers_that_were_measured(kind, velocity):
    node = torch.arange(7)
    seen, points = kind.at(1, node), torch.rand(7, 3).double()
    samples = torch.from_numpy(kind.projected(velocity)[1]).flatten(1)[:, node].T
    rows, values, weight, beam = seen.spline_rows(points, samples, torch.ones(7))
    if kind.full:
        assert beam is None and torch.equal(rows, points) and torch.equal(values, samples)
    else:
        expected = torch.from_numpy(kind.components(velocity)[1]).flatten(1)[:, node].flatten()
        torch.testing.assert_close((values * beam).sum(1), expected, rtol=1e-5, atol=1e-6)
        assert len(rows) == len(weight) == 7 * kind.parts


def test_two_components_give_two_rows_each():
    directions = torch.eye(3, dtype=torch.float64)[:2, None].expand(2, 5, 3)
    seen, points = Components(directions, full=False), torch.rand(5, 3).double()
    samples = torch.rand(5, 3).double() * torch.tensor([1.0, 1.0, 0.0])
    rows, values, weight, beam = seen.spline_rows(points, samples, torch.ones(5))
    assert torch.equal(rows, points.repeat(2, 1)) and len(weight) == 10
    torch.testing.assert_close((values * beam).sum(1), samples[:, :2].T.flatten())
    torch.testing.assert_close(seen.of(samples.T), samples[:, :2].T)


def test_what_needs_vectors_is_refused(kind):
    if kind.full:
        kind.require_full("this imposes")
    else:
        with pytest.raises(ValueError, match="this imposes full vectors and the measurement holds (one|two) component"):
            kind.require_full("this imposes")


def test_it_is_public():
    assert {"MeasurementType", "measurement_type"} <= set(geometry.__all__)
