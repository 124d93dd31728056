"""Doppler against the true velocity along the beam, its bound, and full vectors from tilted beams."""

import math

import numpy as np
import pytest
import torch
from ultrasound_cases import cube, lattice, packet

from torchsph.ultrasound.acquisition import Acquisition, Beams, Packet
from torchsph.ultrasound.estimation.doppler import ColourDoppler, colour_doppler, vector_doppler
from torchsph.ultrasound.measurements.doppler import DopplerOptions

PLAIN = ColourDoppler(clutter=None)


def test_phase_of_a_turning_constant_is_the_speed():
    acquisition, grid = Acquisition(), cube(6)
    speed = 0.2
    turn = -acquisition.phase_per_metre * speed * acquisition.interval * torch.arange(16, dtype=torch.float64)
    iq = torch.exp(1j * turn).view(-1, 1, 1, 1).expand(-1, *grid.shape)
    found = colour_doppler(Packet(iq, grid, acquisition, Beams()), lattice(half=0), PLAIN)
    assert float(found.speed) == pytest.approx(speed, rel=1e-9)
    assert float(found.coherence) == pytest.approx(1)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.5, 0.0, 1.0), (-0.3, 0.4, 1.0)])
def test_speed_along_the_beam_of_moving_scatterers(direction):
    velocity, beams = (0.15, -0.1, 0.12), Beams(direction)
    found = colour_doppler(packet(velocity, 1, beams=beams), lattice(), PLAIN)
    true = float(np.dot(velocity, beams.direction))
    assert float(found.speed.mean()) == pytest.approx(true, abs=0.005)
    z = (found.speed - true) / found.sigma
    assert 0.2 < float(z.square().mean().sqrt()) < 1.6  # the bound is for one speckle per window


def test_fast_flow_wraps_round_at_the_aliasing_speed():
    limit = Acquisition().aliasing_speed
    found = colour_doppler(packet((0.0, 0.0, limit + 0.1), 2), lattice(half=1), PLAIN)
    assert float(found.speed.median()) == pytest.approx(-limit + 0.1, abs=0.03)


def test_clutter_is_removed_and_still_blood_is_not_believed():
    moving = colour_doppler(packet((0.0, 0.0, 0.15), 3, clutter=40.0), lattice(half=1), ColourDoppler())
    assert moving.accepted.all() and float(moving.speed.median()) == pytest.approx(0.15, abs=0.02)
    still = colour_doppler(packet((0.0, 0.0, 0.0), 3, clutter=40.0), lattice(half=1), ColourDoppler())
    assert not still.accepted.any()


def test_nan_and_silence_are_not_accepted():
    scene = packet((0.0, 0.0, 0.1), 4, grid=cube(6))
    for value in (0.0, float("nan")):
        found = colour_doppler(scene.with_iq(torch.full_like(scene.iq, value)), lattice(half=0), PLAIN)
        assert not found.accepted.any() and torch.isfinite(found.speed).all()


def test_vectors_from_three_beams_equal_a_dense_weighted_solution():
    generator = torch.Generator().manual_seed(0)
    beams = torch.nn.functional.normalize(torch.randn((5, 3), generator=generator, dtype=torch.float64), dim=1)
    velocity = torch.randn((7, 3), generator=generator, dtype=torch.float64)
    sigma = 0.5 + torch.rand((5, 7), generator=generator, dtype=torch.float64)
    speed = beams @ velocity.T + torch.randn((5, 7), generator=generator, dtype=torch.float64)
    found, deviation = vector_doppler(beams, speed, sigma)
    for point in range(7):
        rows = beams.numpy() / sigma[:, point].numpy()[:, None]
        exact = np.linalg.lstsq(rows, (speed[:, point] / sigma[:, point]).numpy(), rcond=None)[0]
        np.testing.assert_allclose(found[point].numpy(), exact, atol=1e-10)
        np.testing.assert_allclose(deviation[point].numpy(), np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))))


def test_beams_that_do_not_span_are_refused():
    with pytest.raises(ValueError, match="span"):
        vector_doppler(torch.eye(3)[:2], torch.zeros((2, 4)), torch.ones((2, 4)))


def test_steered_beams_lie_at_their_angle_on_both_sides():
    directions = np.array([beams.direction for beams in DopplerOptions(steering=20.0).beams(3)])
    assert directions.shape == (4, 3)
    np.testing.assert_allclose(directions @ [0, 0, 1], math.cos(math.radians(20)))
    np.testing.assert_allclose(directions.sum(0)[:2], 0, atol=1e-12)
    assert len(DopplerOptions(steering=20.0).beams(2)) == 2


def test_points_outside_and_single_images_are_refused():
    scene = packet((0.0, 0.0, 0.0), 5, grid=cube(6))
    with pytest.raises(ValueError, match="outside"):
        colour_doppler(scene, lattice(half=4), PLAIN)
    with pytest.raises(ValueError, match="two images"):
        colour_doppler(scene.with_iq(scene.iq[:1]), lattice(half=0), PLAIN)
