"""What runs on a GPU, run on a pretended one: nothing mixes devices, and little makes the processor wait.

The pretended device refuses what a GPU would and counts what it would be waited for (``pretend_device``); numbers are
held against a run on the processor. The kernels themselves are tested in ``test_triton.py``.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from pretend_device import NAME, Pretend, PretendedCuda, pretended_device

import geometry
import regularize
from torchsph import Scene, Simulator, preset
from torchsph.data import sample_measurement
from torchsph.pairs import available_backends
from torchsph.pairs.poisson import _LOOK_EVERY
from torchsph.ultrasound import EchoModel, LinearFlow, SpeckleTracker, simulate_packet

needs_compiled = pytest.mark.skipif(
    not next(status.present for status in available_backends() if status.name == "cpu"),
    reason="the compiled pair sums stand for the kernels of the device",
)
SPACING, MEMBERS = 3e-3, 2
# how often in a step a file may make the processor wait, and why it has to
WAITS = {
    "torchsph/simulator/advancing.py": (4, "whether members are left, wait, need hopeless steps, have broken"),
    "torchsph/simulator/failures.py": (1, "whether all numbers are finite"),
    "torchsph/simulator/state/neighbour_list.py": (2, "whether any list, or all, have to be made anew"),
    "torchsph/simulator/state/clock.py": (2.2, "the time at which planes of openings are placed, on the processor"),
    "torchsph/simulator/stepping/pressure.py": (2, "whether walls move and the solver has converged"),
    "torchsph/simulator/valves/cavity_volume.py": (2, "tables of volume and its rate"),
    "torchsph/simulator/valves/free_channel.py": (2, "which way the flow goes through an opening"),
    "torchsph/simulator/valves/plane_groups.py": (2, "whether members see the same planes of openings"),
    "torchsph/simulator/valves/reservoirs.py": (5, "who has crossed an opening, rows of the buffers, what turns round"),
    "torchsph/simulator/valves/openings.py": (1, "particles near the rim"),
    "torchsph/simulator/valves/volume_match.py": (1, "particles near the plane"),
    "torchsph/simulator/walls/compiled.py": (1, "particles near a wall"),
    "torchsph/pairs/backends/checks.py": (1, "how many members there are"),
    "torchsph/pairs/backends/triton_backend.py": (1, "how many members the list has"),
    "torchsph/pairs/interface.py": (1, "whether positions can be searched"),
}
# beside these: once an interval, and when particles come or go
RARE = {"torchsph/simulator/state/particles.py", "torchsph/simulator/state/checks.py"}
UPLOADS = 6  # a step, of a few numbers each


@pytest.fixture(scope="module", name="sample")
def _sample():
    return geometry.read_recording(sample_measurement()).select(slice(8, 10))


@pytest.fixture(name="device")
def _device(monkeypatch):
    with pretended_device() as device:
        yield device


def cycle(model, recording, device=None):
    """Impose, project, advance, fetch.

    Returns what is fetched, the run, what the steps made the processor wait for, and velocities after 4 ms.
    """
    run = model.start(float(recording.time[0]), members=MEMBERS)
    masks = [torch.from_numpy(np.array(mask, bool)).to(model.device) for mask in recording.mask]
    field = torch.from_numpy(np.nan_to_num(recording.velocity[0])).to(model.device)
    run.impose(recording.grid, field, masks[0])
    run.project(2)
    if device is not None:
        device.forget()
    run.advance(float(recording.time[0]) + 4e-3)
    early = run.particles.velocity.clone()
    run.advance(float(recording.time[1]))
    waits = (Counter(), Counter()) if device is None else (Counter(device.waits), Counter(device.uploads))
    return run.fetch(recording.grid, masks[1]), run, waits, early


@pytest.fixture(scope="module", name="ran")
def _ran(sample):
    with pytest.MonkeyPatch.context() as patch, pretended_device() as device:
        backend = PretendedCuda()
        patch.setattr("torchsph.simulator.simulator.choose_backend", lambda *_: backend)
        model = Simulator(Scene.from_recording(sample, SPACING), preset("default"), device=NAME, dtype=torch.float64)
        return cycle(model, sample, device)


@needs_compiled
class TestCycle:
    def test_is_the_same_as_on_the_processor(self, ran, sample):
        found, run, _, early = ran
        # the solver without a coarse level, as the device has it
        plain = Simulator(
            Scene.from_recording(sample, SPACING), preset("default"), dtype=torch.float64, backend="reference"
        )
        wanted, other, _, before = cycle(plain, sample)
        assert isinstance(found.value, Pretend) and isinstance(run.particles.position, Pretend)
        assert int(run.record.steps.held[0]) == int(other.record.steps[0])
        assert torch.equal(found.covered.held, wanted.covered)
        assert (early.held - before).norm() < 1e-12 * before.norm()
        # later a rounding sorts a particle into another class of ``Neighbourhood.excess``, which moves its neighbours
        assert (found.value.held - wanted.value).norm() < 2e-3 * wanted.value.norm()

    def test_waits_for_nothing_that_is_not_listed(self, ran):
        _, run, (waits, _), _ = ran
        steps, by_file = int(run.record.steps.held[0]), Counter()
        for (_, place), count in waits.items():
            by_file[place.split(":")[0]] += count
        iterations = int(run.record.pressure_iterations.held.max())
        looks = by_file.pop("torchsph/pairs/poisson.py")
        assert looks <= iterations / _LOOK_EVERY + 2 * steps < iterations
        unknown = set(by_file) - set(WAITS) - RARE
        assert not unknown, f"makes the processor wait for the GPU: {unknown}"
        for name, (least, why) in WAITS.items():
            # a handful more in the interval itself, and in a step in which particles come or go
            assert by_file[name] <= least * steps + 40, f"{name} waits {by_file[name]} times in {steps} steps: {why}"
        assert sum(by_file.values()) <= 32 * steps

    def test_sends_little(self, ran):
        _, run, (_, uploads), _ = ran
        assert sum(uploads.values()) <= UPLOADS * int(run.record.steps.held[0])


class TestFields:
    """Splines and the tracker, on small problems; the filters' grids stay on the processor."""

    def test_spline_fits_are_those_of_the_processor(self, device):
        axis = (torch.arange(7, dtype=torch.float64) + 0.5) * 0.01
        points = torch.cartesian_prod(axis, axis, axis)
        velocity = torch.stack([torch.sin(60 * points[:, 1]), torch.cos(50 * points[:, 2]), 0 * points[:, 0]], 1)
        fixed = regularize.Smoother(spacing=(0.01,) * 3, wall=None).fixed(no_slip=None)
        there = points.to(NAME), velocity.to(NAME)
        wanted = fixed.fit(points, velocity, divergence_points=points, uncertainty=True)
        found = fixed.fit(*there, divergence_points=there[0], uncertainty=True)
        assert torch.allclose(found(there[0]).held, wanted(points), atol=1e-9)
        # errors that samples share are looked for on the processor alone (``Problem.shared``)
        alone = wanted.std(points).square() / wanted.posterior.inflation.square()
        assert torch.allclose(found.std(there[0]).held.square(), alone, rtol=1e-6)
        several = torch.stack([velocity, 2.0 * velocity])
        many = fixed.fit_many(there[0], several.to(NAME), divergence_points=there[0])
        assert torch.allclose(many[1](there[0]).held, 2.0 * wanted(points), atol=1e-8)

    @pytest.mark.slow
    def test_a_search_for_smoothness_ends_on_the_device(self, device):
        generator = torch.Generator().manual_seed(0)
        axis = (torch.arange(7, dtype=torch.float64) + 0.5) * 0.01
        points = torch.cartesian_prod(axis, axis, axis)
        velocity = torch.stack([torch.sin(60 * points[:, 1]), torch.cos(50 * points[:, 2]), 0 * points[:, 0]], 1)
        velocity = velocity + 0.1 * torch.randn(velocity.shape, generator=generator, dtype=torch.float64)
        smoother = regularize.Smoother(spacing=(0.01,) * 3, wall=None)
        found = smoother.fit(points.to(NAME), velocity.to(NAME), divergence_points=points.to(NAME))
        assert torch.allclose(
            found(points.to(NAME)).held, smoother.fit(points, velocity, divergence_points=points)(points)
        )

    def test_tracks_as_the_processor_does(self, device):
        side, step = 18, 1e-3 / 6
        grid = geometry.Grid((-0.5 * (side - 1) * step,) * 2 + (0.06,), (step,) * 3, (side,) * 3)
        seed = torch.Generator().manual_seed(0)
        packet = simulate_packet(LinearFlow((0.3, 0.2, 0.25)), grid, EchoModel(), 0.0, seed)
        points = grid.nodes().view(side, side, side, 3)[6:-6:3, 6:-6:3, 6:-6:3].reshape(-1, 3)
        tracker = SpeckleTracker(backend="reference")
        found = tracker.track(replace(packet, iq=packet.iq.to(NAME)), points)
        wanted = tracker.track(packet, points)
        assert torch.allclose(found.velocity.cpu(), wanted.velocity, atol=1e-5, equal_nan=True)


class TestDevice:
    def test_refuses_what_a_gpu_refuses(self, device):
        here, there = torch.ones(3), torch.ones(3, device=NAME)
        with pytest.raises(RuntimeError, match="same device"):
            here + there
        with pytest.raises(RuntimeError, match="same device"):
            torch.where(there > 0, here, there)
        assert ((there + torch.tensor(1.0)).held == 2.0).all()  # a single number may come from anywhere

    def test_counts_what_makes_the_processor_wait(self, device):
        there = torch.arange(4.0, device=NAME)
        device.forget()
        assert float(there.sum()) == 6.0 and bool((there > 2).any())
        assert there[there > 1].shape == (2,) and len(torch.nonzero(there)) == 3
        assert there.cpu().tolist() == there.tolist()
        kinds = Counter(kind for (kind, _), count in device.waits.items() for _ in range(count))
        assert kinds == {"item": 2, "mask": 1, "nonzero": 1, "download": 2}
        device.forget()
        there = there * 2.0 + there.roll(1).index_select(0, torch.zeros(4, dtype=torch.int64, device=NAME))
        assert not device.waits and not device.uploads

    def test_changes_in_place_reach_the_numbers(self, device):
        there = torch.zeros(2, 3, device=NAME)
        there[0] += 1.0
        there.T[2, 1] = 5.0
        assert there.tolist() == [[1.0, 1.0, 1.0], [0.0, 0.0, 5.0]]
