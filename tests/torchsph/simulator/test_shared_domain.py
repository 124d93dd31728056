"""A simulator owns nothing that runs change: its runs may be stepped in any order."""

import numpy as np
import pytest
import torch

import geometry
from torchsph import Scene, Simulator, preset

STEP = 1e-3  # s


@pytest.fixture(scope="module")
def scene():
    ventricle = geometry.Ventricle()
    recording = ventricle.recording(np.arange(0.0, 0.4401, 0.01), grid_spacing=3e-3, wall_spacing=3e-3)
    return Scene.from_recording(recording, 3e-3)


def advanced(run, start, number):
    run.advance(start + number * STEP)
    if run.can_project:  # enters an interval of its own
        run.project()


@pytest.mark.parametrize("name", ["default", "weakly_compressible", "thesis"])
def test_two_runs_in_turns_give_the_bits_of_each_alone(scene, name):
    """One fills while the other ejects, so that walls, open valves and buffers differ all the time."""
    starts = (0.30, 0.09)
    shared = Simulator(scene, preset(name))
    together = [shared.start(start, seed=1) for start in starts]
    for number in (1, 2, 3):
        for run, start in zip(together, starts, strict=True):
            advanced(run, start, number)
    for run, start in zip(together, starts, strict=True):
        alone = Simulator(scene, preset(name)).start(start, seed=1)
        for number in (1, 2, 3):
            advanced(alone, start, number)
        assert torch.equal(run.particles.position, alone.particles.position)
        assert torch.equal(run.particles.velocity, alone.particles.velocity)
        assert repr(run.record.summary()) == repr(alone.record.summary())
        assert int(run.record.steps) > 2 and not bool(run.record.failed)
