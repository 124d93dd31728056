"""Confidences that particles carry: what they count for in fetching and in XSPH."""

import numpy as np
import pytest
import torch

import geometry
from torchsph import XSPH, PotentialWall, Scene, Simulator, WeaklyCompressible
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.simulator.scene import Fluid
from torchsph.simulator.state.particles import Particles

SCENE = Scene(spacing=1 / 16, fluid=Fluid(1.0, 0.0), period=(1.0, 1.0), dimension=2)
GRID = geometry.Grid((0.0, 0.0), (1 / 16, 1 / 16), (17, 17))
EVERYWHERE = torch.ones(17, 17, dtype=torch.bool)


def started(confidence, backend="auto", dtype=torch.float64, **changes):
    """Disordered particles with a random imposed field and a confidence for every node."""
    scheme = WeaklyCompressible(wall=PotentialWall(), shifting=None, **changes)
    run = Simulator(SCENE, scheme, dtype=dtype, backend=backend).start(0.0, seed=2)
    noise = torch.randn((2, 17, 17), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    run.impose(GRID, noise, EVERYWHERE, confidence)
    return run


def ramp():
    """Confidence that rises along x from 0 to 1 across the grid."""
    return torch.linspace(0.0, 1.0, 17, dtype=torch.float64).expand(17, 17).clone()


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_fetching_is_the_weighted_least_squares_fit(backend):
    """At a node: the constant of the line fitted by numpy with weights W(|s|) times confidence."""
    run = started(ramp(), backend)
    p, node = run.particles, torch.tensor([8.0, 8.0], dtype=torch.float64)
    torch.testing.assert_close(p.confidence, p.position[:, 0] / 16)  # linear in x, and so sampled exactly
    mask = torch.zeros_like(EVERYWHERE)
    mask[8, 8] = True
    found = run.fetch(GRID, mask)
    offset = p.position - node
    smoothing = kernel("wendland_c2").value(offset.norm(dim=1), 1.0, 2)
    root = (smoothing * p.confidence).sqrt()[:, None].numpy()
    matrix = np.concatenate([np.ones((p.count, 1)), offset.numpy()], 1)
    fitted = np.linalg.lstsq(root * matrix, root * p.velocity.numpy(), rcond=None)[0][0]
    np.testing.assert_allclose(found.value[0, :, 8, 8].numpy(), fitted, rtol=1e-10)
    plain = started(None, backend).fetch(GRID, mask).value[0, :, 8, 8]
    assert not np.allclose(plain.numpy(), fitted, rtol=1e-3)


@pytest.mark.parametrize("level", ["velocity", "position"])
@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_xsph_weighs_neighbours_by_their_confidence(backend, level):
    """A step with XSPH differs from one without by eps sum_b w_b 2 m_b / (rho_a + rho_b) (v_b - v_a) W."""
    order = "thesis" if level == "velocity" else "symplectic"
    ends = []
    for xsph in (None, XSPH(0.3, level)):
        run = started(ramp(), backend, xsph=xsph, order=order)
        start = run.particles
        run.advance(1e-5)
        assert int(run.record.steps) == 1
        ends.append(run.particles)
    without, with_it = ends
    p = without if level == "velocity" else start
    gap = p.position[:, None] - p.position[None]
    gap = gap - 16 * torch.round(gap / 16)
    smoothing = kernel("wendland_c2").value(gap.norm(dim=2), 1.3, 2)
    share = smoothing * (p.mass * p.confidence)[None] / (1 + 0.5 * (p.deviation[:, None] + p.deviation[None]))
    pull = (share[:, :, None] * (p.velocity[None] - p.velocity[:, None])).sum(1)
    if level == "velocity":
        torch.testing.assert_close(with_it.velocity - without.velocity, 0.3 * pull, rtol=0, atol=1e-12)
    else:
        moved = torch.remainder(with_it.position - without.position + 8, 16) - 8
        torch.testing.assert_close(moved, 0.3e-5 * 16 * pull, rtol=1e-9, atol=1e-12)


def test_confidence_of_one_changes_nothing_and_stays_with_its_particle():
    ends = []
    for confidence in (None, torch.ones(17, 17)):
        run = started(confidence, xsph=XSPH(0.3, "position"))
        run.advance(0.01)
        ends.append(run.particles)
    torch.testing.assert_close(ends[0].position, ends[1].position, rtol=0, atol=1e-12)
    run = started(ramp())
    before = run.particles.confidence
    run.advance(0.01)
    assert torch.equal(run.particles.confidence, before)
    run.impose(GRID, torch.zeros(2, 17, 17), EVERYWHERE)
    assert run.particles.confidence is None


def test_particles_that_join_are_trusted():
    one = started(ramp()).particles
    plain = Particles(
        **{n: getattr(one, n) for n in ("position", "velocity", "deviation", "mass", "member", "kind")}, members=1
    )
    both = one.joined(plain)
    assert torch.equal(both.confidence, torch.cat([one.confidence, torch.ones_like(one.confidence)]))
    assert plain.joined(one).confidence is None


def test_confidence_must_not_be_negative():
    with pytest.raises(ValueError, match="confidence must be finite and not negative, but is -0.5"):
        started(ramp() - 0.5)
