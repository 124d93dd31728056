"""Speckle tracking: accuracy on uniform motion, and the hard cases."""

import dataclasses
import math

import pytest
import torch
from ultrasound_cases import STEP, cube, lattice, packet

from geometry import Grid
from torchsph.ultrasound.acquisition import Acquisition, Beams, Packet
from torchsph.ultrasound.estimation.clutter import FIRFilter
from torchsph.ultrasound.estimation.estimates import Flag
from torchsph.ultrasound.estimation.tracking import SpeckleTracker
from torchsph.ultrasound.scanner.echoes import EchoModel, simulate_packet

PLAIN = SpeckleTracker(clutter=None)


def flagged(estimates, flag):
    return (estimates.flags & int(flag)) != 0


@pytest.mark.parametrize("velocity", [(0.31, 0.17, 0.23), (-0.62, 0.44, 0.51)])
def test_uniform_motion_is_measured_within_the_stated_error(velocity):
    """|bias| <= 1 % of the speed, deviation about 2 % lateral and 0.1 % axial of 1 m/s."""
    points, errors = lattice(), []
    for seed in range(3):
        found = PLAIN.track(packet(velocity, seed), points)
        assert found.accepted.float().mean() > 0.98
        errors.append(found.velocity[found.accepted] - torch.tensor(velocity))
    error = torch.cat(errors)
    deviation = error.std(0)
    assert (deviation[:2] < 0.02).all() and deviation[2] < 1.2e-3
    speed = math.hypot(*velocity)
    assert (error.mean(0).abs() < 0.01 * speed + 0.003).all()  # 375 points, some 60 of them independent


def test_a_moving_mirror_of_the_scene_mirrors_the_velocity():
    scene = packet((0.3, 0.1, 0.0), 1)
    mirrored = scene.with_iq(scene.iq.flip(-1), noise=scene.noise)
    points = lattice()
    there, here = (
        PLAIN.track(p, q).velocity for p, q in ((scene, points), (mirrored, points * torch.tensor([-1, 1, 1])))
    )
    torch.testing.assert_close(there[:, 0], -here[:, 0], atol=1e-4, rtol=0)
    torch.testing.assert_close(there[:, 1:], here[:, 1:], atol=1e-4, rtol=0)


def test_planes_are_tracked_as_volumes_are():
    grid = cube(30, (0.0, 20e-3))
    velocity = (0.35, 0.22)
    found = PLAIN.track(packet(velocity, 2, grid=grid, beams=Beams((0.0, 1.0))), lattice((0.0, 20e-3), 3))
    error = found.velocity[found.accepted] - torch.tensor(velocity)
    assert found.accepted.float().mean() > 0.95
    assert error[:, 0].std() < 0.05 and error[:, 1].std() < 5e-3


def test_double_precision_agrees_with_single():
    points = lattice(half=1)
    scene = packet((0.2, 0.3, 0.1), 3)
    double = scene.with_iq(scene.iq.to(torch.complex128), noise=scene.noise)
    single, exact = PLAIN.track(scene, points), PLAIN.track(double, points)
    assert exact.velocity.dtype == torch.float64
    torch.testing.assert_close(single.velocity.double(), exact.velocity, atol=2e-3, rtol=0)


def test_the_tile_does_not_matter():
    points, scene = lattice(half=1), packet((0.2, 0.3, 0.1), 3)
    parts = [SpeckleTracker(clutter=None, tile=tile).track(scene, points).velocity for tile in (4, 1000)]
    torch.testing.assert_close(*parts, atol=1e-4, rtol=0)


def test_compiled_sums_give_the_estimates_of_torch():
    """With everything that goes into them: filter, shear, all lags, a rim cut off and a sample that is NaN."""
    scene = packet((0.2, 0.1, 0.3), 11, gradient=((0, 0, 0), (0, 0, 0), (100.0, 0, 0)), dtype=torch.float64)
    iq = scene.iq.clone()
    iq[3, 30, 30, 30] = float("nan")
    scene, points = scene.with_iq(iq, noise=scene.noise), lattice(half=3)
    found, exact = (SpeckleTracker(backend=name).track(scene, points) for name in ("auto", "reference"))
    assert torch.equal(found.flags, exact.flags) and torch.equal(found.lag, exact.lag)
    for name in ("velocity", "correlation", "peak_ratio", "curvature", "variance", "power", "snr", "response", "shear"):
        torch.testing.assert_close(getattr(found, name), getattr(exact, name), rtol=1e-7, atol=1e-9)


def test_following_shear_halves_its_error():
    gradient = ((0, 0, 0), (0, 0, 0), (150.0, 0, 0))
    points = lattice()
    error = {}
    for follow in (False, True):
        tracker = SpeckleTracker(clutter=None, follow_shear=follow)
        off = []
        for seed in range(2):
            found = tracker.track(packet((0.2, 0.1, 0.2), seed, gradient=gradient), points)
            true = torch.tensor([0.2, 0.1, 0.2]) + torch.outer(points[:, 0].float(), torch.tensor([0, 0, 150.0]))
            off.append((found.velocity - true)[:, 0].abs())
        error[follow] = float(torch.cat(off).median())
    assert error[True] < 0.5 * error[False]


@pytest.mark.parametrize("gradient", [(60.0, 0, 0), (0, 100.0, 0), (0, 0, 50.0), (40.0, 40.0, -40.0)])
def test_shear_is_told_to_some_per_cent(gradient):
    scene = packet((0.2, 0.1, 0.25), gradient=((0, 0, 0), (0, 0, 0), gradient))
    found = PLAIN.track(scene, lattice())
    assert float(found.shear.median()) == pytest.approx(math.hypot(*gradient), rel=0.15)


class Parabola:
    """Axial flow 0.1 + 6e4 x^2 in blood everywhere."""

    def velocity(self, points, time):
        axial = 0.1 + 6e4 * points[:, 0].square()
        return torch.stack([0 * axial, 0 * axial, axial], 1)

    def blood(self, points, time):
        return torch.ones(len(points), dtype=torch.bool)


def test_a_bend_of_the_axial_flow_is_told():
    """Half a kernel off, a parabola c x^2 is off its tangent by c h^2, on either side: 2 c h^2 off a straight line."""
    axis = torch.arange(-3, 4, dtype=torch.float64) * 1e-3
    points = torch.cartesian_prod(torch.zeros(1, dtype=torch.float64), axis, axis) + torch.tensor([0.0, 0.0, 24e-3])
    scene = simulate_packet(Parabola(), cube(24), EchoModel(), 0.0, torch.Generator().manual_seed(0))
    assert float(PLAIN.track(scene, points).bend.median()) == pytest.approx(2 * 6e4 * 0.5e-3**2, rel=0.3)


def test_what_shear_leaves_of_the_correlation_is_believed():
    """150/s leaves exp(-(0.25 ms 150/s k s)^2 / 4) = 0.86, k the phase per metre and s = 0.51 mm: below either gate."""
    gradient = ((0, 0, 0), (0, 0, 0), (150.0, 0, 0))
    scene, points = packet((0.2, 0.1, 0.2), gradient=gradient), lattice()
    found = PLAIN.track(scene, points)
    true = torch.tensor([0.2, 0.1, 0.2]) + torch.outer(points[:, 0].float(), torch.tensor([0, 0, 150.0]))
    error = found.velocity - true
    assert float(found.correlation.median()) == pytest.approx(0.86 / 1.01, abs=0.02)
    assert found.accepted.float().mean() > 0.9 and (found.lag == 1).float().mean() > 0.9
    assert error[found.accepted][:, 2].std() < 0.012 and error[found.accepted][:, :2].std() < 0.15


# hard cases


def test_speed_beyond_the_search_is_flagged():
    found = PLAIN.track(packet((1.5, 0.0, 0.0), 4), lattice(half=1))
    assert flagged(found, Flag.EDGE).float().mean() > 0.9
    assert found.accepted.float().mean() < 0.05


def test_zero_flow_without_a_filter_is_zero_and_with_one_is_not_believed():
    scene, points = packet((0.0, 0.0, 0.0), 5), lattice(half=1)
    still = PLAIN.track(scene, points)
    assert still.accepted.all() and still.velocity.abs().max() < 0.15
    filtered = SpeckleTracker(clutter=FIRFilter()).track(scene, points)
    assert not filtered.accepted.any()


def test_clutter_of_sixty_decibel_is_filtered_away():
    velocity = (0.3, 0.1, 0.2)
    found = SpeckleTracker(min_blood=-80.0).track(
        packet(velocity, 6, clutter=60.0, dtype=torch.float64), lattice(half=1)
    )
    error = found.velocity[found.accepted] - torch.tensor(velocity)
    assert found.accepted.float().mean() > 0.95 and error[:, 2].std() < 0.01
    assert found.power.median() < -50


@dataclasses.dataclass(frozen=True)
class BesideTissue:
    """Blood moves for x < 0; beyond is tissue that creeps along the beam."""

    velocity_of_blood: tuple
    creep: float = 2e-3

    def blood(self, points, time):
        return points[:, 0] < 0

    def velocity(self, points, time):
        still = points.new_tensor((0.0, 0.0, self.creep))
        return torch.where(self.blood(points, time)[:, None], points.new_tensor(self.velocity_of_blood), still)


def test_blood_beside_tissue_of_sixty_decibel():
    """Far from it blood is tracked, at its edge and inside it nothing is believed."""
    flow, points = BesideTissue((0.1, 0.2, 0.25)), lattice(half=3)
    scene = simulate_packet(
        flow, cube(24), EchoModel(tissue=60.0), 0.0, torch.Generator().manual_seed(9), dtype=torch.float64
    )
    found = SpeckleTracker(max_snr=30.0, min_blood=-80.0).track(scene, points)
    far, beyond = points[:, 0] < -2.5e-3, points[:, 0] > 0.5e-3
    error = (found.velocity - flow.velocity(points, 0.0))[far & found.accepted]
    assert found.accepted[far].double().mean() > 0.8 and not found.accepted[beyond].any()
    assert error[:, 2].abs().median() < 0.01 and error[:, :2].abs().median() < 0.1


def test_a_kernel_without_scatterers_is_flagged_alone():
    scene, points = packet((0.2, 0.1, 0.1), 10, snr=None), lattice()
    hole = (scene.grid.nodes() - torch.tensor([0.0, 0.0, 24e-3])).abs().amax(1) < 0.7e-3
    found = PLAIN.track(scene.with_iq(torch.where(hole.view(scene.grid.shape), 0, scene.iq)), points)
    empty = (points - torch.tensor([0.0, 0.0, 24e-3])).abs().amax(1) < 0.1e-3
    assert flagged(found, Flag.WEAK).tolist() == empty.tolist()
    assert found.accepted[~empty].float().mean() > 0.6 and not found.velocity[empty].any()


def test_no_scatterers_and_a_constant_image_are_flagged():
    grid, points = cube(12), lattice(half=1)
    for value in (0.0, 1.0):
        iq = torch.full((16, *grid.shape), value, dtype=torch.complex64)
        found = PLAIN.track(Packet(iq, grid, Acquisition(), Beams()), points)
        assert not found.accepted.any() and torch.isfinite(found.velocity).all()
    assert flagged(found, Flag.FLAT).all()


def test_nan_spoils_its_neighbourhood_alone():
    scene, points = packet((0.2, 0.1, 0.1), 7), lattice()
    iq = scene.iq.clone()
    iq[5, 18, 18, 18] = float("nan")
    found, clean = PLAIN.track(scene.with_iq(iq, noise=scene.noise), points), PLAIN.track(scene, points)
    distance = (points - torch.tensor([0.0, 0.0, 24e-3])).abs().amax(1)
    assert flagged(found, Flag.NOT_FINITE).tolist() == (distance < 0.6e-3).tolist()
    assert torch.isfinite(found.velocity).all()
    far = distance > 1.6e-3
    torch.testing.assert_close(found.velocity[far], clean.velocity[far], atol=0.02, rtol=0)


def test_a_volume_smaller_than_the_kernel_is_flagged_not_fatal():
    grid = Grid((0.0, 0.0, 24e-3), (STEP,) * 3, (9, 2, 9))
    iq = torch.view_as_complex(torch.randn((16, *grid.shape, 2), generator=torch.Generator().manual_seed(0)))
    found = PLAIN.track(Packet(iq, grid, Acquisition(), Beams()), torch.tensor([[4 * STEP, 0.0, 24e-3 + 4 * STEP]]))
    assert flagged(found, Flag.SAMPLES).all()


def test_one_image_and_points_outside_are_refused():
    scene = packet((0.0, 0.0, 0.0), 8, grid=cube(8))
    with pytest.raises(ValueError, match="the packet has 1"):
        PLAIN.track(scene.with_iq(scene.iq[:1]), lattice(half=0))
    with pytest.raises(ValueError, match="longer packet"):
        SpeckleTracker().track(scene.with_iq(scene.iq[:9]), lattice(half=0))
    with pytest.raises(ValueError, match="outside the image"):
        PLAIN.track(scene, lattice(half=4))


def test_no_points_give_no_estimates():
    found = PLAIN.track(packet((0.0, 0.0, 0.0), 8, grid=cube(8)), torch.zeros((0, 3), dtype=torch.float64))
    assert found.velocity.shape == (0, 3)


def test_options_are_checked():
    for options, message in (
        ({"kernel": 0.0}, "kernel"),
        ({"lags": (2, 1)}, "lags"),
        ({"min_samples": 1}, "min_samples"),
        ({"backend": "gpu"}, "backend"),
    ):
        with pytest.raises(ValueError, match=message):
            SpeckleTracker(**options)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: the echo chain is tested on the CPU only")
def test_the_chain_runs_on_a_cuda_device():
    flow, points = BesideTissue((0.1, 0.2, 0.25)), lattice(half=1) - torch.tensor([3e-3, 0.0, 0.0])
    scene = simulate_packet(flow, cube(24), EchoModel(), 0.0, torch.Generator("cuda").manual_seed(0))
    there = SpeckleTracker().track(scene, points.cuda())
    here = SpeckleTracker().track(dataclasses.replace(scene, iq=scene.iq.cpu()), points)
    torch.testing.assert_close(there.velocity.cpu(), here.velocity, atol=2e-3, rtol=0)
