"""Population control: crowds are merged and holes seeded again, and mass and momentum only change hands."""

import math

import numpy as np
import pytest
import torch

import geometry
from torchsph import PopulationControl, Scene, Simulator, preset
from torchsph.simulator.scene import Fluid
from torchsph.simulator.state.particles import Particles

SIDE = {2: 24, 3: 10}
SCHEMES = [("weakly_compressible", {"sound_speed": 10.0}), ("projection", {})]
DIMENSIONS = [2, 3]


def simulator(scheme, options, dimension=2, dtype=torch.float64, every=5):
    side = SIDE[dimension]
    scene = Scene(spacing=1 / side, fluid=Fluid(1.0, 0.01), period=(1.0,) * dimension, dimension=dimension)
    return Simulator(scene, preset(scheme, population=PopulationControl(every=every), **options), dtype=dtype)


def lattice(dimension):
    axis = torch.arange(SIDE[dimension], dtype=torch.float64) + 0.5
    place = torch.cartesian_prod(*[axis] * dimension)
    generator = torch.Generator().manual_seed(0)
    return place + 0.05 * (2 * torch.rand(place.shape, generator=generator, dtype=torch.float64) - 1)


def distance(place, centre, side):
    way = place - centre
    return (way - side * torch.round(way / side)).norm(dim=1)


def disturbed(dimension, what, centre=None):
    """Places (N, D) and masses (N,) of a box with a hole, or with a crowd of sixty crumbs, around ``centre``."""
    side, place = SIDE[dimension], lattice(dimension)
    centre = torch.full((dimension,), 0.5 * side) if centre is None else torch.tensor(centre)
    if what == "hole":
        place = place[distance(place, centre, side) > (3.0 if dimension == 2 else 1.8)]
        return place, torch.full_like(place[:, 0], side**dimension / len(place))
    generator = torch.Generator().manual_seed(1)
    crowd = centre + 0.6 * torch.rand((60, dimension), generator=generator, dtype=torch.float64)
    mass = torch.cat([torch.ones(len(place)), torch.full((60,), 0.02)]).double()
    return torch.cat([place, torch.remainder(crowd, side)]), mass


def particles(place, mass, velocity, dtype=torch.float64):
    label = torch.zeros(len(place), dtype=torch.int64)
    arrays = (place, velocity, 0 * mass, mass)
    return Particles(*(array.to(dtype) for array in arrays), label, label, 1)


def vortex(place, side):
    x, y = (2 * math.pi * place[:, :2] / side).unbind(1)
    flow = [-torch.cos(x) * torch.sin(y), torch.sin(x) * torch.cos(y), torch.zeros_like(x)]
    return torch.stack(flow[: place.shape[1]], 1)


def widest_gap(p, side):
    """The largest distance (spacings) of any place from the particle nearest to it, on nodes 0.4 apart."""
    axis = torch.arange(0.0, side, 0.4, dtype=torch.float64)
    nodes = torch.cartesian_prod(*[axis] * p.dimension)
    return max(float(distance_to(p.position, some, side).max()) for some in nodes.split(500))


def distance_to(place, nodes, side):
    way = nodes[:, None] - place[None]
    return (way - side * torch.round(way / side)).norm(dim=2).amin(1)


def totals(p):
    return p.mass.double().sum(), (p.mass[:, None] * p.velocity).double().sum(0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("dimension", DIMENSIONS)
@pytest.mark.parametrize("what", ["hole", "crowd"])
def test_mass_and_momentum_only_change_hands(what, dimension, dtype):
    place, mass = disturbed(dimension, what)
    start = particles(place, mass, vortex(place, SIDE[dimension]), dtype)
    run = simulator(*SCHEMES[0], dimension, dtype).resume(start, 0.0)
    after, changed = run._population.controlled(start, torch.tensor([True]))
    assert changed and after.count != start.count
    bound = 1e-12 if dtype == torch.float64 else 1e-5
    for late, early in zip(totals(after), totals(start), strict=True):
        torch.testing.assert_close(late, early, rtol=0, atol=bound * float(mass.sum()))
    assert bool((after.mass > 0).all())
    gained = run.record.reseeded if what == "hole" else -run.record.merged
    assert int(gained) == after.count - start.count


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_what_is_uniform_stays_so_and_what_is_linear_is_met(dimension):
    """A uniform velocity at every particle; a linear one at those put in for single particles that are missing."""
    place, mass = disturbed(dimension, "hole")
    flow = torch.tensor([0.3, -0.2, 0.1][:dimension], dtype=torch.float64)
    start = particles(place, mass, flow.expand(len(place), dimension))
    run = simulator(*SCHEMES[0], dimension).resume(start, 0.0)
    after, _ = run._population.controlled(start, torch.tensor([True]))
    torch.testing.assert_close(after.velocity, flow.expand_as(after.velocity), rtol=0, atol=1e-12)
    single = lattice(dimension)
    single = single[distance(single, torch.full((dimension,), SIDE[dimension] / 2 + 0.5), SIDE[dimension]) > 0.5]
    slope = torch.tensor([[0.1, 0.2, 0.0], [-0.3, 0.05, 0.1], [0.0, 0.2, -0.15]], dtype=torch.float64)
    slope = slope[:dimension, :dimension]
    start = particles(single, torch.ones(len(single), dtype=torch.float64), single @ slope)
    run = simulator(*SCHEMES[0], dimension).resume(start, 0.0)
    after, _ = run._population.controlled(start, torch.tensor([True]))
    new = slice(start.count, after.count)
    assert after.count == start.count + 1
    torch.testing.assert_close(after.velocity[new], after.position[new] @ slope, rtol=0, atol=1e-10)


def after_steps(scheme, options, dimension, what, centre, every):
    place, mass = disturbed(dimension, what, centre)
    start = particles(place, mass, vortex(place, SIDE[dimension]))
    run = simulator(scheme, options, dimension, every=every).resume(start, 0.0)
    while int(run.record.steps) < 40:
        run.advance(run.time + 0.02)
    assert not bool(run.record.failed.any())
    return run


@pytest.mark.parametrize(
    ("scheme", "options", "dimension"),
    [
        ("weakly_compressible", {"sound_speed": 10.0, "shifting": None}, 2),
        ("projection", {"shifting": None, "relaxation": 2.0}, 2),
        ("projection", {"shifting": None, "relaxation": 2.0}, 3),
    ],
)
def test_a_hole_closes_and_a_crowd_thins_while_the_flow_goes_on(scheme, options, dimension):
    """Within forty steps, over the seams of the box too; without the control both are still there.

    Shifting, where it is strong, closes such a hole as well: it is off.
    """
    side, gaps, crowds = SIDE[dimension], [], []
    for every in (5, 10_000):
        gaps.append(widest_gap(after_steps(scheme, options, dimension, "hole", None, every).particles, side))
        run = after_steps(scheme, options, dimension, "crowd", [0.2] * dimension, every)
        crowds.append(run.particles.count - side**dimension)
    assert gaps[0] < 1.0 and gaps[1] > 1.5
    assert abs(crowds[0]) <= 3 and crowds[1] == 60


def test_each_member_is_controlled_for_itself():
    """A batch of a disturbed and an even box: the even one is left as it is, and so is one whose turn it is not."""
    place, mass = disturbed(2, "hole")
    even = lattice(2)
    both = particles(place, mass, vortex(place, 24))
    other = particles(even, torch.ones(len(even), dtype=torch.float64), vortex(even, 24))
    start = Particles(**{**both.arrays()}, members=2).joined(other.changed(member=other.member + 1))
    run = simulator(*SCHEMES[0]).resume(start, 0.0)
    alone = simulator(*SCHEMES[0]).resume(both, 0.0)
    for due in ([True, True], [False, True]):
        after, changed = run._population.controlled(start, torch.tensor(due))
        assert torch.equal(after.position[after.member == 1], even) and changed == due[0]
    expected, _ = alone._population.controlled(both, torch.tensor([True]))
    after, _ = run._population.controlled(start, torch.tensor([True, True]))
    for name in ("position", "velocity", "mass"):
        torch.testing.assert_close(getattr(after, name)[after.member == 0], getattr(expected, name))


def test_what_flows_through_valves_is_all_that_changes_the_mass():
    """The thesis's preset, where particles crowd and leave holes at the valves: mass inside = start - left."""
    ventricle = geometry.Ventricle()
    recording = ventricle.recording(np.arange(0.0, 0.3001, 0.02), grid_spacing=3e-3, wall_spacing=2e-3)
    scene = Scene.from_recording(recording, 2e-3)
    run = Simulator(scene, preset("thesis", population=PopulationControl(every=10))).start(0.08, members=2)
    before = run.particles.per_member(run.particles.mass.double(), "sum")
    run.advance(0.12)
    p = run.particles
    passed = (run.record.inflow - run.record.outflow).sum(1) / scene.spacing**3
    torch.testing.assert_close(p.per_member(p.mass.double(), "sum"), before + passed, rtol=1e-5, atol=0)
    assert int(run.record.merged.sum()) > 0 and float(passed.abs().min()) > 0
    assert run.record.merged.tolist() == run.record.summary()["merged"] and int(run.record.outside.sum()) == 0


@pytest.mark.parametrize("scheme", ["weakly_compressible", "projection"])
def test_a_hole_at_a_wall_is_filled_and_nothing_lands_beyond(scheme):
    box = geometry.polygon(np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float), 1 / 32)
    scene = Scene(spacing=1 / 16, walls=geometry.WallMotion.at_rest(box), dimension=2)
    run = Simulator(scene, preset(scheme), dtype=torch.float64).start(0.0)
    p = run.particles
    stay = (p.position - torch.tensor([8.0, 0.0]).double()).norm(dim=1) > 2.5
    gone, rest = p.mass[~stay].sum(), p.mass[stay].sum()
    holed = p.select(stay)
    holed = holed.changed(mass=holed.mass * (gone + rest) / rest)
    scheme = preset(scheme, population=PopulationControl(every=2))
    run = Simulator(scene, scheme, dtype=torch.float64).resume(holed, 0.0)
    while int(run.record.steps) < 20:
        run.advance(run.time + 0.02)
    q = run.particles
    assert 0.6 * int((~stay).sum()) <= int(run.record.reseeded) <= 1.3 * int((~stay).sum())
    assert float((q.position - torch.tensor([8.0, 0.0]).double()).norm(dim=1).min()) < 1.5
    stray = q.changed(position=q.position.index_fill(0, torch.tensor([0]), 1e6))  # no endless grid of cells for it
    after, _ = run._population.controlled(stray, torch.tensor([True]))
    assert bool(torch.isfinite(after.velocity).all()) and abs(after.count - q.count) < 5
    assert int(run.record.outside) == 0 and float(q.mass.sum()) == pytest.approx(float(p.mass.sum()), rel=1e-12)


def test_options_that_cannot_be():
    for options, message in (
        ({"every": 0}, "at least 1 step"),
        ({"closest": 1.5}, "closest must lie in"),
        ({"heaviest": 0.0}, "heaviest must be positive"),
        ({"missing": -1.0}, "missing must be positive"),
    ):
        with pytest.raises(ValueError, match=message):
            PopulationControl(**options)
    place = lattice(2)
    half = place[place[:, 0] < 12]
    with pytest.raises(ValueError, match="needs fluid that fills its walls or its box; it fills 50 %"):
        simulator(*SCHEMES[0]).resume(particles(half, torch.ones(len(half)).double(), 0 * half), 0.0)
