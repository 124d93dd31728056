"""Slips of a caller of the simulator's public routes: each is refused by its name where it enters, none goes on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

import geometry
import torchsph as ts
from torchsph.simulator.seeding import Seeding
from torchsph.simulator.simulation import Simulation
from torchsph.simulator.state.particles import Particles

BODY = geometry.ellipse((5e-3, 5e-3), 1e-3)
SHELL = replace(BODY, region=(BODY.centroids[:, 0] > 4e-3).astype(np.uint8))
MOTION = geometry.WallMotion.through(
    np.array([0.0, 0.01, 0.02]), np.stack([s * SHELL.vertices for s in (1.0, 1.01, 1.02)]), SHELL.faces, SHELL.region
)
VALVE = ts.Valve(1, ((0.0, 1.0),))
SCENE = ts.Scene(spacing=1.5e-3, walls=MOTION, valves=(VALVE,), dimension=2)
MODEL = ts.Simulator(SCENE, ts.preset("default"), seeding=Seeding(relaxations=2, packings=0))
GRID = geometry.Grid((-5e-3, -5e-3), (2e-3, 2e-3), (6, 6))
SPACE = geometry.Grid((-5e-3,) * 3, (2e-3,) * 3, (6, 6, 6))
MASK = torch.ones(6, 6, dtype=torch.bool)
FLOW, WEIGHT = torch.zeros(2, 6, 6), torch.ones(6, 6)
RUN = MODEL.start(0.0)
SEEDED = RUN.particles
NAN = math.nan


def at(value: float, field: torch.Tensor, *place: int) -> torch.Tensor:
    """The field with another value at one place."""
    return field.index_put(tuple(torch.tensor(number) for number in place), torch.tensor(value))


def resumed(**changes: object) -> Simulation:
    return MODEL.resume(replace(SEEDED, **changes), 0.0)


def scene(**changes: object) -> ts.Scene:
    return replace(SCENE, **changes)


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "fetch in space": (lambda: RUN.fetch(SPACE, torch.ones(6, 6, 6) > 0), "grid of 3 dimensions, .* simulation of 2"),
    "fetch with a shorter mask": (
        lambda: RUN.fetch(GRID, MASK[1:]),
        r"mask must have the shape \(6, 6\), got \(5, 6\)",
    ),
    "fetch with weights": (lambda: RUN.fetch(GRID, WEIGHT), "mask must be of torch.bool"),
    "fetch with numpy": (
        lambda: RUN.fetch(GRID, MASK.numpy()),
        "mask must be a dense tensor of real numbers, got an array .ndarray. of bool",
    ),
    "fetch with meta": (
        lambda: RUN.fetch(GRID, MASK.to("meta")),
        "mask must be a dense tensor of real numbers, got a tensor of bool on meta",
    ),
    "impose in space": (lambda: RUN.impose(SPACE, torch.zeros(3, 6, 6, 6), MASK), "grid of 3 dimensions"),
    "impose NaN": (lambda: RUN.impose(GRID, at(NAN, FLOW, 0, 2, 3), MASK), r"not finite at 1 nodes .*\(2, 3\)"),
    "impose infinity": (lambda: RUN.impose(GRID, at(math.inf, FLOW, 1, 0, 0), MASK), "velocity is not finite"),
    "impose nowhere": (lambda: RUN.impose(GRID, FLOW, ~MASK), "mask holds no node"),
    "impose integers": (lambda: RUN.impose(GRID, FLOW.long(), MASK), "velocity must hold floating-point numbers"),
    "impose for others": (
        lambda: RUN.impose(GRID, FLOW.repeat(3, 1, 1, 1), MASK),
        r"velocity must have the shape \(2, 6",
    ),
    "confidence below 0": (lambda: RUN.impose(GRID, FLOW, MASK, at(-0.1, WEIGHT, 3, 3)), r"is -0.1 at \(3, 3\)"),
    "short confidence": (lambda: RUN.impose(GRID, FLOW, MASK, WEIGHT[0]), "confidence must have the shape"),
    "confidence in nothing": (
        lambda: RUN.impose(GRID, FLOW, MASK, 0 * WEIGHT),
        "confidence is 0 at every node of the m",
    ),
    "confidence beside the mask": (
        lambda: RUN.impose(GRID, FLOW, MASK & (WEIGHT.cumsum(0) < 2), (WEIGHT.cumsum(0) > 2) * WEIGHT),
        "confidence is 0 at every node of the mask, .* or None for all alike",
    ),
    "pull by nothing": (lambda: RUN.pull(GRID, FLOW, WEIGHT, 0 * WEIGHT), "weight is 0 at every node, .*do not pull"),
    "pull in space": (lambda: RUN.pull(SPACE, FLOW, WEIGHT, WEIGHT), "grid of 3 dimensions"),
    "pull to NaN": (lambda: RUN.pull(GRID, at(NAN, FLOW, 0, 2, 3), WEIGHT, WEIGHT), "target is not finite"),
    "pull by NaN": (
        lambda: RUN.pull(GRID, FLOW, at(NAN, WEIGHT, 1, 1), WEIGHT),
        "gain must be from 0 to 1, but is nan",
    ),
    "pull too hard": (lambda: RUN.pull(GRID, FLOW, 2 * WEIGHT, WEIGHT), "gain must be from 0 to 1, but is 2"),
    "pull with NaN": (lambda: RUN.pull(GRID, FLOW, WEIGHT, NAN * WEIGHT), "weight must be finite and not negative"),
    "advance to NaN": (lambda: RUN.advance(NAN), r"must be finite \(s\), got nan"),
    "advance to infinity": (lambda: RUN.advance(math.inf), r"must be finite \(s\), got inf"),
    "advance to text": (lambda: RUN.advance("1"), "must be finite"),
    "advance to many": (lambda: RUN.advance(torch.ones(3)), "must be one number"),
    "advance backwards": (lambda: RUN.advance(-0.01), "cannot advance backwards"),
    "past the last frame": (lambda: RUN.advance(0.03), "wall is known from 0 to 0.02 s, not at 0.03 s"),
    "start past it": (lambda: MODEL.start(0.03), "wall is known from 0 to 0.02 s"),
    "start at NaN": (lambda: MODEL.start(NAN), "time must be finite"),
    "start of no member": (lambda: MODEL.start(0.0, members=0), "at least one member"),
    "start of half a member": (
        lambda: MODEL.start(0.0, members=1.5),
        "Simulator.start: members must be a whole number, got 1.5",
    ),
    "start of countless members": (lambda: MODEL.start(0.0, members=10**9), "up to 65536, got 1000000000"),
    "no number of members": (
        lambda: MODEL.start(0.0, members=NAN),
        "Simulator.start: members must be a whole number, got nan",
    ),
    "no seed": (lambda: MODEL.start(0.0, seed=None), "seed must be a whole number, got None"),
    "fetch on no grid": (lambda: RUN.fetch((6, 6), MASK), r"grid must be a Grid, got \(6, 6\)"),
    "fetch sparse": (lambda: RUN.fetch(GRID, MASK.to_sparse()), "mask must be a dense tensor"),
    "project by halves": (lambda: RUN.project(0.5), "times must be a whole number, got 0.5"),
    "sparse mass": (lambda: resumed(mass=SEEDED.mass.to_sparse()), "mass must be a dense tensor"),
    "mass of None": (lambda: resumed(mass=None), "the particles' mass must be a tensor, got NoneType"),
    "spacing of text": (lambda: scene(spacing="1 mm"), "Scene: spacing must be a number, got '1 mm'"),
    "valve of text": (lambda: scene(valves="mitral"), "Scene: valves must be a sequence, each a Valve, got 'mitral'"),
    "pressure of infinity": (
        lambda: ts.Valve(1, ((0.0, 1.0),), pressure=math.inf),
        "Valve: pressure must be finite, got inf",
    ),
    "flux of NaN": (lambda: ts.Valve(1, ((0.0, 1.0),), flux=NAN), "Valve: flux must be finite, got nan"),
    "endless run-out": (lambda: ts.Reservoir(run_out=math.inf), "Reservoir: run_out must be finite, got inf"),
    "slip of NaN": (
        lambda: ts.CompleteKernelWall(no_slip=NAN),
        "CompleteKernelWall: no_slip must be True or False, got nan",
    ),
    "half a try": (lambda: ts.Rollback(tries=1.5), "Rollback: tries must be a whole number, got 1.5"),
    "support of infinity": (
        lambda: ts.preset("default", smoothing_ratio=math.inf),
        "Projection: smoothing_ratio must be finite, got inf",
    ),
    "speed of text": (lambda: ts.preset("weakly_compressible", sound_speed="fast"), "sound_speed must be a number"),
    "odd transfer": (lambda: ts.Transfer(projections=NAN), "Transfer: projections must be a whole number"),
    "odd memory": (lambda: ts.EnsembleOptions(model_error=NAN), "EnsembleOptions: model_error must be finite, got nan"),
    "odd seeding": (lambda: Seeding(packings=NAN), "Seeding: packings must be a whole number"),
    "odd seed": (lambda: MODEL.start(0.0, seed=2**70), "seed must be a whole number"),
    "resume at NaN": (lambda: MODEL.resume(SEEDED, NAN), "time must be finite"),
    "particles of space": (lambda: resumed(position=torch.ones(SEEDED.count, 3)), "position must have the shape"),
    "no member": (lambda: resumed(members=0), "at least one member, got 0"),
    "member 5": (lambda: resumed(member=SEEDED.member + 5), "member runs from 5 to 5, but there are 1"),
    "member below 0": (lambda: resumed(member=SEEDED.member - 1), "member runs from -1 to -1"),
    "kind 9": (lambda: resumed(kind=SEEDED.kind + 9), "kind runs from 9 to 9, but the scene has 1 openings"),
    "no mass": (lambda: resumed(mass=0 * SEEDED.mass), "mass must be positive"),
    "mass of infinity": (lambda: resumed(mass=at(math.inf, SEEDED.mass, 0)), "those of one run are alike"),
    "valve of no times": (lambda: ts.Valve(1, None), "Valve: intervals must be a sequence, .*, got None"),
    "half a valve": (lambda: ts.Valve(1, ((0.0,),)), "Valve: intervals must be a sequence, each .a number, a number."),
    "densities of text": (lambda: ts.Rollback(density=("low", 2.0)), "Rollback: density must be .a number, a number."),
    "no model": (lambda: ts.residual_motion(None, 0.0), "residual_motion: simulator must be a Simulator, got None"),
    "endless motion": (lambda: ts.residual_motion(MODEL, 0.0, duration=300), "duration must be from 1e-09 to 1"),
    "no density": (lambda: resumed(deviation=SEEDED.deviation - 2), "must be above -1"),
    "NaN everywhere": (lambda: resumed(velocity=NAN * SEEDED.velocity), "not finite in every member"),
    "NaN confidence": (lambda: resumed(confidence=NAN * SEEDED.mass), "confidence must be finite"),
    "no such device": (lambda: replace(MODEL, device="cuda:71"), "this machine has no 'cuda:71'"),
    "device of another kind": (lambda: replace(MODEL, device="meta"), "device 'meta' is not supported"),
    "nonsense for a device": (lambda: replace(MODEL, device="nonsense"), "unknown device 'nonsense'"),
    "infinite spacing": (lambda: scene(spacing=math.inf), "Scene: spacing must be finite, got inf"),
    "infinite speed": (lambda: scene(reference_speed=math.inf), "Scene: reference_speed must be finite, got inf"),
    "infinite density": (lambda: ts.Fluid(math.inf), "Fluid: density must be finite, got inf"),
    "infinite viscosity": (lambda: ts.Fluid(1.0, math.inf), "Fluid: viscosity must be finite, got inf"),
    "NaN gravity": (lambda: scene(gravity=(0.0, NAN)), "Scene: gravity must be without NaN"),
    "period of 0": (lambda: ts.Scene(1.0, period=(0.0, 1.0), dimension=2), "period must be positive and finite"),
    "walls of a plane": (lambda: scene(dimension=3), "dimension is 3, but its walls have 2"),
    "valve without faces": (lambda: scene(valves=(ts.Valve(9, ((0.0, 1.0),)),)), "region 9 has no face in the walls"),
    "valve twice": (lambda: scene(valves=(VALVE, VALVE)), "two valves have the same region"),
    "region 300": (lambda: ts.Valve(300, ((0.0, 1.0),)), "a whole number from 1 .* to 255, got 300"),
    "region 1.5": (lambda: ts.Valve(1.5, ((0.0, 1.0),)), "whole number"),
    "tiny period": (lambda: ts.Valve(1, ((0.0, 5e-13),), 1e-12).events(0.0, 1.0), "fits more than 100000 times into"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused(name: str) -> None:
    call, words = REFUSED[name]
    before = RUN.particles
    with pytest.raises((ValueError, TypeError), match=words):
        call()
    assert RUN.particles is before and RUN.time == 0.0


@pytest.mark.parametrize("name", list(SEEDED.arrays()))
def test_particles_whose_arrays_disagree_are_refused(name: str) -> None:
    array = getattr(SEEDED, name)
    other = array.double() if array.is_floating_point() else array.int()
    for change in (array[:1], array[:0], torch.cat([array, array]), array.to("meta"), array.numpy(), other):
        with pytest.raises((ValueError, TypeError), match="the particles' "):
            resumed(**{name: change})
        run = resumed()
        run.particles = run.particles.changed(**{name: change})
        with pytest.raises((ValueError, TypeError), match="the particles' "):
            run.advance(1e-3)


def test_what_is_not_known_may_be_anything() -> None:
    run = MODEL.start(0.0)
    holed, known = at(NAN, FLOW, 0, 2, 3), MASK.clone()
    known[2, 3] = False
    run.impose(GRID, holed, known)
    run.pull(GRID, holed, WEIGHT, known.double())
    assert bool(torch.isfinite(run.particles.velocity).all()) and bool(run.fetch(GRID, known).covered.any())


def test_one_broken_member_among_others_is_data() -> None:
    """A failed member may be handed on: it stays flagged, and the other goes on."""
    two = SEEDED.repeated(2)
    lost = torch.where(two.member[:, None] == 1, NAN, two.velocity)
    run = MODEL.resume(two.changed(velocity=lost), 0.0)
    run.advance(1e-3)
    assert run.record.failed.tolist() == [False, True]


def test_a_start_far_away_in_time_costs_nothing_with_a_period() -> None:
    """Ten million beats later the wall is where it was; the times in between are not listed."""
    cycle = geometry.WallMotion.through(
        MOTION.time,
        np.stack([SHELL.vertices, 1.02 * SHELL.vertices, SHELL.vertices]),
        SHELL.faces,
        SHELL.region,
        period=0.02,
    )
    far = 2e5
    model = replace(MODEL, scene=scene(walls=cycle, valves=()))
    breaks = model.domain.breaks(far, far + 0.02)
    near = model.domain.breaks(0.0, 0.02)
    np.testing.assert_allclose(np.array(breaks) - far, near, atol=1e-4)


def test_particles_of_a_plane_do_not_enter_space() -> None:
    box = geometry.box((0, 0, 0), (0.01, 0.01, 0.01), 5e-3)
    model = ts.Simulator(ts.Scene(2e-3, walls=geometry.WallMotion.at_rest(box)), ts.preset("default"))
    with pytest.raises(ValueError, match=r"position must have the shape \(\d+, 3\)"):
        model.resume(SEEDED, 0.0)
    assert isinstance(SEEDED, Particles)
