"""Fluxes that a recording has measured, walls that it calls uncertain, valves that leak: each counts by its error."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import geometry
from regularize import Smoother
from torchsph import Scene, Simulator, Valve, preset
from torchsph.methods.measurement.flux_data import flux_data
from torchsph.methods.measurement.frame_splines import FrameSmoother
from torchsph.methods.measurement.wall_rows import mean_certainty, open_regions, wall_rows

RADIUS, LENGTH, PEAK, STEP = 0.008, 0.03, 0.6, 2e-3
FLUX = 0.5 * PEAK * math.pi * RADIUS**2
ALWAYS = ((-1.0, 1.0),)


def noisy_tube(noise: float = 0.3, **more: object) -> geometry.Recording:
    """One frame of Poiseuille flow through a rigid tube along z, from opening 1 to opening 2."""
    tube = geometry.tube(RADIUS, LENGTH, STEP)
    grid = geometry.Grid.covering((-0.009, -0.009, 0), (0.009, 0.009, LENGTH), STEP)
    points = grid.nodes().numpy()
    square = (points[:, :2] ** 2).sum(1) / RADIUS**2
    mask = (square < 1).reshape(grid.shape)
    field = np.zeros((1, 3, *grid.shape), np.float32)
    field[:, 2] = PEAK * np.where(mask, (1 - square).reshape(grid.shape), 0)
    field += np.where(mask, noise * np.random.default_rng(0).standard_normal(field.shape), 0)
    wall = geometry.Wall(tube.vertices, tube.faces, tube.region)
    rows = np.array([[1.0, -1.0, 1.0], [2.0, -1.0, 1.0]])
    return geometry.Recording(np.zeros(1), grid, field, mask[None], wall, 1060.0, 4e-3, valve_intervals=rows, **more)


def through(recording: geometry.Recording) -> np.ndarray:
    """The fluxes inwards through the openings 1 and 2 of the recording's spline, m^3/s."""
    frames = FrameSmoother(recording, Smoother().fixed(curvature=1e-3))
    fitted = frames.fit(0)
    asked = replace(recording, fluxes=tuple(geometry.OpeningFlux(region, [0.0]) for region in (1, 2)))
    data = flux_data(asked, frames.motion, 0, fitted)
    return (data.of(fitted) - data.value).numpy()


def test_a_measured_flux_moves_the_splines_by_its_error():
    plain = noisy_tube()
    before = through(plain)
    assert before.sum() == pytest.approx(0.0, abs=1e-4 * FLUX)  # a rigid tube passes what it takes in
    wanted = 1.5 * before[0]
    sharp = through(replace(plain, fluxes=(geometry.OpeningFlux(1, [wanted], [1e-4 * FLUX]),)))
    assert sharp[0] == pytest.approx(wanted, rel=1e-3) and sharp[1] == pytest.approx(-wanted, rel=1e-3)
    vague = through(replace(plain, fluxes=(geometry.OpeningFlux(1, [wanted], [1e3 * FLUX]),)))
    np.testing.assert_allclose(vague, before, rtol=1e-3)
    between = through(replace(plain, fluxes=(geometry.OpeningFlux(1, [wanted], [0.02 * FLUX]),)))
    assert before[0] < between[0] < wanted


def test_uncertain_walls_weigh_less_and_certain_ones_as_ever():
    plain = noisy_tube()
    knots = 3 * STEP
    motion = geometry.WallMotion.from_recording(plain)
    sigma = np.where(plain.wall.vertices[:, 0] > 0, knots, 0.0)
    half = replace(plain, wall=replace(plain.wall, sigma=sigma))
    sure, unsure = (wall_rows(one, motion, 0, knots=knots) for one in (plain, half))
    factor = (unsure.weight / sure.weight).numpy()
    assert set(np.round(factor, 6)) == {0.5, 1.0}
    assert mean_certainty(plain, 0, knots) == 1.0 and 0.7 < mean_certainty(half, 0, knots) < 0.8
    exact = replace(plain, wall=replace(plain.wall, sigma=0.0 * sigma))
    assert torch.equal(wall_rows(exact, motion, 0, knots=knots).weight, sure.weight)


def simulated(scene: Scene, time: float = 0.004) -> torch.Tensor:
    """(openings,) fluxes inwards, m^3/s, of a run a few steps on."""
    run = Simulator(scene, preset("default")).start(0.0, seed=0)
    run.advance(time)
    unit = run.units.length**3 / run.units.time
    openings, clock = run.domain.valves.openings, run.surroundings.clock
    from torchsph.simulator.valves.flux_split import fluxes

    found = fluxes(openings, clock, torch.zeros(1))
    return torch.stack([found[n][0] for n in sorted(found)]) * unit


def test_measured_fluxes_that_contradict_the_wall_are_reconciled_by_their_errors():
    """2 in and 1 out through a tube that keeps its volume: the less certain one gives way four times as far."""
    both = (geometry.OpeningFlux(1, [2e-5], [1e-6]), geometry.OpeningFlux(2, [-1e-5], [2e-6]))
    scene = Scene.from_recording(noisy_tube(fluxes=both), 4e-3)
    assert [valve.flux_sigma for valve in scene.valves] == [1e-6, 2e-6]
    torch.testing.assert_close(simulated(scene), torch.tensor([1.8e-5, -1.8e-5]), rtol=1e-4, atol=0)


def test_one_measured_flux_is_taken_and_the_other_opening_answers():
    scene = Scene.from_recording(noisy_tube(fluxes=(geometry.OpeningFlux(2, [-1e-5], [1e-6]),)), 4e-3)
    torch.testing.assert_close(simulated(scene), torch.tensor([1e-5, -1e-5]), rtol=1e-4, atol=0)


def test_a_source_that_nothing_answers_is_named():
    motion = geometry.WallMotion.at_rest(geometry.tube(RADIUS, LENGTH, STEP))
    scene = Scene(4e-3, walls=motion, valves=(Valve(1, ALWAYS, flux=1e-5), Valve(2, ((0.5, 0.6),))))
    with pytest.raises(ValueError, match="region 1 miss the change of the cavity's volume .* no open valve takes"):
        simulated(scene)


def test_a_valve_that_leaks_shares_by_what_stays_open_and_has_no_rows():
    motion = geometry.WallMotion.at_rest(geometry.tube(RADIUS, LENGTH, STEP))
    leaking = Valve(2, (), leak=0.25)
    assert leaking.passes(0.0) and not leaking.is_open(0.0) and leaking.open_part(0.0) == 0.25
    assert not Valve(2, ()).passes(0.0)
    run = Simulator(Scene(4e-3, walls=motion, valves=(Valve(1, ALWAYS), leaking)), preset("default")).start(0.0)
    run.advance(1e-3)
    from torchsph.simulator.valves.flux_split import fluxes

    found = fluxes(run.domain.valves.openings, run.surroundings.clock, torch.ones(1))
    torch.testing.assert_close(torch.stack([found[0][0], found[1][0]]), torch.tensor([0.8, 0.2]), rtol=0.05, atol=0)
    recording = noisy_tube(valve_leak=np.array([[2.0, 0.25]]))
    shut = replace(recording, valve_intervals=np.array([[1.0, -1.0, 1.0]]))
    assert open_regions(shut, 0.0) == (1, 2)
    assert [valve.leak for valve in Scene.from_recording(shut, 4e-3).valves] == [None, 0.25]


@pytest.mark.parametrize(
    ("fields", "rule"),
    [({"leak": 1.0}, "leak of region 1 must lie in"), ({"flux_sigma": -1.0}, "flux_sigma of region 1 must be finite")],
)
def test_errors_that_cannot_be_are_refused(fields, rule):
    with pytest.raises(ValueError, match=rule):
        Valve(1, ALWAYS, **fields)


def test_both_ends_under_one_label_are_two_openings():
    """Their area vectors cancel: one plug for both would be without bounds (1e13 m/s where walls move)."""
    apart = noisy_tube()
    region = np.minimum(apart.wall.region, 1)
    together = replace(apart, wall=replace(apart.wall, region=region), valve_intervals=np.array([[1.0, -1.0, 1.0]]))
    fields = []
    for one in (apart, together):
        frames = FrameSmoother(one, Smoother().fixed(curvature=1e-3))
        rows = wall_rows(one, frames.motion, 0)
        assert bool((rows.velocity == 0).all()) and len(rows.points) == int((one.wall.region == 0).sum())
        fields.append(frames.fit(0)(frames.nodes[torch.from_numpy(one.mask[0].reshape(-1))]))
    assert torch.equal(*fields)
