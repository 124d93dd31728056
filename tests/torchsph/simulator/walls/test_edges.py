"""Sharp edges, thin gaps and fast walls: no particle gets out and nothing becomes infinite."""

import numpy as np
import pytest
import torch
import trimesh
from wall_cases import assert_all_inside, assert_nothing_went_wrong

import geometry
from torchsph import Scene, Simulator, preset

SPACING = 1e-3
SOUND = preset("weakly_compressible").sound_speed
FAST = 0.3 * SOUND
WAY = 3e-3

# corners in spacings
SHAPES = {
    "90 degrees": [[0, 0], [12, 0], [12, 12], [0, 12]],
    "30 degrees": [[0, 0], [24, 0], [24, 24 * np.tan(np.pi / 6)]],
    "gap of 3": [[0, 0], [20, 0], [20, 3], [0, 3]],
}


def outline(name):
    corners = SPACING * np.array(SHAPES[name], float)
    return corners - corners.mean(0)


def prism(name, depth):
    """The outline carried along z, as a closed surface of few large triangles."""
    flat = outline(name)
    hull = trimesh.convex.convex_hull(
        np.concatenate([np.c_[flat, np.zeros(len(flat))], np.c_[flat, np.full(len(flat), depth)]])
    )
    return geometry.Surface(hull.vertices, hull.faces)


def shaken(vertices, phase):
    """Across and back: the whole body, x as much as y."""
    moved = vertices.copy()
    moved[:, :2] += WAY * (1 - np.cos(phase)) / np.sqrt(2)
    return moved


def squeezed(vertices, phase):
    """Half as long again and back, at constant volume."""
    stretch = 1 + 0.25 * (1 - np.cos(phase))
    return vertices * np.array([stretch, 1 / stretch, 1.0])[: vertices.shape[1]]


def kicked(vertices, phase):
    """At full speed from the start, into a fluid at rest."""
    moved = vertices.copy()
    moved[:, 1] += WAY * phase
    return moved


def run_with(surface, move, dtype, turns=1.0, frames=13, scheme="weakly_compressible"):
    """A run through ``turns`` of a motion whose fastest vertex moves with 0.3 of the sound speed."""
    phase = np.linspace(0, 2 * np.pi * turns, frames)
    fine = np.linspace(0, 2 * np.pi * turns, 721)
    path = np.stack([move(surface.vertices, p) for p in fine])
    fastest = np.linalg.norm(np.gradient(path, fine, axis=0), axis=2).max()
    rate = FAST / fastest  # rad/s
    step = 1e-5
    places = np.stack([move(surface.vertices, p) for p in phase])
    rates = np.stack([rate * (move(surface.vertices, p + step) - move(surface.vertices, p)) / step for p in phase])
    motion = geometry.WallMotion.through(phase / rate, places, surface.faces, surface.region, rates=rates)
    scene = Scene(spacing=SPACING, walls=motion, dimension=surface.dimension)
    run = Simulator(scene, preset(scheme), dtype=dtype).start(0.0)
    for time in motion.time[1:]:
        run.advance(float(time))
        assert_nothing_went_wrong(run)
        assert_all_inside(run)
    assert torch.isfinite(run.particles.velocity).all() and torch.isfinite(run.particles.deviation).all()
    return run


@pytest.mark.parametrize(
    ("scheme", "dtype"),
    [("weakly_compressible", torch.float32), ("weakly_compressible", torch.float64), ("projection", torch.float32)],
)
@pytest.mark.parametrize("move", [shaken, squeezed, kicked])
@pytest.mark.parametrize("name", list(SHAPES))
def test_nothing_leaks_in_a_plane(name, move, scheme, dtype):
    run = run_with(geometry.polygon(outline(name), SPACING), move, dtype, turns=0.5, scheme=scheme)
    if scheme == "weakly_compressible":
        assert float(run.record.largest_mach.max()) > 0.2  # the fluid did go along


@pytest.mark.parametrize("name", ["30 degrees", "gap of 3"])
def test_nothing_leaks_in_space(name):
    run_with(prism(name, 8 * SPACING), shaken, torch.float32, turns=0.5, frames=5)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", list(SHAPES))
def test_nothing_leaks_in_space_over_two_turns(name, dtype):
    run_with(prism(name, 8 * SPACING), shaken, dtype, turns=2.0, frames=25)
