"""The Triton backend against the reference: on a GPU where there is one, else under Triton's interpreter."""

from __future__ import annotations

import importlib.util
import os
import sys
import types

import pytest
import torch
from pair_cases import as_dtype, assert_close, changed, disordered, support

from torchsph.pairs import MomentumTerms, RateTerms, ReferenceBackend, available_backends, choose_backend
from torchsph.pairs.backends.triton_backend import CudaBackend
from torchsph.pairs.smoothing_kernels import KERNELS

REFERENCE = ReferenceBackend()
RATES = RateTerms("volume", True, True, True, True, True)
FORCES = MomentumTerms("switched", artificial=0.3, laminar=0.1)
needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None,
    reason="triton is not installed (it comes with torch's CUDA builds): the cuda backend is not tested here",
)


@pytest.fixture(scope="module", name="fast")
def _fast():
    if torch.cuda.is_available():
        yield choose_backend("cuda", "cuda")
        return
    before = os.environ.get("TRITON_INTERPRET")
    os.environ["TRITON_INTERPRET"] = "1"  # read when triton compiles, that is, at the first CudaBackend()
    try:
        yield CudaBackend()
    finally:
        if before is None:
            del os.environ["TRITON_INTERPRET"]
        else:
            os.environ["TRITON_INTERPRET"] = before


def both(fast, state, radius, period=None):
    """The state on the backend's device with its pairs, and the same for the reference in float64."""
    state = changed(state, lambda tensor: tensor.to(fast.device))
    wide = as_dtype(changed(state, lambda tensor: tensor.cpu()), torch.float64)
    pairs = fast.search(state.position, state.member, radius, period=period)
    far = None if period is None else period.double().cpu()
    return state, pairs, wide, REFERENCE.search(wide.position, wide.member, radius, period=far)


def same(got, wanted, dtype):
    if isinstance(got, torch.Tensor):
        assert_close(got.cpu(), wanted, dtype)
    else:
        assert_close(changed(got, lambda t: None if t is None else t.cpu()), wanted, dtype)


@needs_triton
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("periodic", [False, True])
class TestTerms:
    def arrange(self, fast, dtype, dimension, periodic):
        side = 8 if dimension == 2 else 4 + 2 * periodic
        choice = support("wendland_c2", dimension, 0.95)
        period = torch.full((dimension,), float(side), dtype=dtype) if periodic else None
        return choice, both(fast, disordered(side, dimension, dtype, members=1 + (not periodic)), choice.radius, period)

    def test_rates_and_forces(self, fast, dtype, dimension, periodic):
        choice, (state, pairs, wide, wanted) = self.arrange(fast, dtype, dimension, periodic)
        for terms in (RATES, RateTerms(None, gradient=True, corrected_diffusion=True, moments=True)):
            same(fast.rates(pairs, state, choice, terms), REFERENCE.rates(wanted, wide, choice, terms), dtype)
        for terms in (FORCES, MomentumTerms("symmetric", 0.3, None, 0.2), MomentumTerms("difference")):
            got = fast.momentum(pairs, state, choice, terms)
            same(got, REFERENCE.momentum(wanted, wide, choice, terms), dtype)

    def test_both_passes_in_one(self, fast, dtype, dimension, periodic):
        choice, (state, pairs, wide, wanted) = self.arrange(fast, dtype, dimension, periodic)
        rates = RateTerms("volume", diffusion=True, xsph=True)
        got = fast.right_hand_side(pairs, state, choice, rates, FORCES)
        expected = REFERENCE.right_hand_side(wanted, wide, choice, rates, FORCES)
        same(got[0], expected[0], dtype)
        same(got[1], expected[1], dtype)

    def test_laplacian(self, fast, dtype, dimension, periodic):
        choice, (state, pairs, wide, wanted) = self.arrange(fast, dtype, dimension, periodic)
        for active in (None, state.deviation > 0):
            got = fast.laplacian(pairs, state, choice, state.pressure, active)
            expected = REFERENCE.laplacian(
                wanted, wide, choice, wide.pressure, None if active is None else active.cpu()
            )
            same(got[0], expected[0], dtype)
            same(got[1], expected[1], dtype)


@needs_triton
@pytest.mark.parametrize("name", sorted(KERNELS))
def test_every_smoothing_kernel(fast, name):
    choice = support(name, 3, 1.5 if name == "spiky" else 0.9)
    state, pairs, wide, wanted = both(fast, disordered(4, 3, torch.float32), choice.radius)
    terms = RateTerms("volume", shepard=True)
    same(fast.rates(pairs, state, choice, terms), REFERENCE.rates(wanted, wide, choice, terms), torch.float32)


@needs_triton
def test_lone_and_coinciding_particles(fast):
    choice = support("wendland_c2", 3)
    lone = changed(disordered(3, 3), lambda t: t[:1])
    state, pairs, _, _ = both(fast, lone, choice.radius)
    assert float(fast.momentum(pairs, state, choice, FORCES).abs().max()) == 0.0
    twice = changed(disordered(3, 3), lambda t: torch.cat([t, t[:5]]))
    state, pairs, wide, wanted = both(fast, twice, choice.radius)
    got = fast.momentum(pairs, state, choice, FORCES)
    same(got, REFERENCE.momentum(wanted, wide, choice, FORCES), torch.float64)


def test_missing_device_is_explained():
    status = next(s for s in available_backends("cpu") if s.name == "cuda")
    assert not status.present and "CUDA tensors only" in status.reason
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="'cuda' was asked for and cannot be used: torch finds no CUDA device"):
            choose_backend("cuda", "cuda")


def test_triton_that_is_too_old_is_explained(monkeypatch):
    """Kernels that hold tuples need 3.3; an older one would fail in the middle of a run."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "some card")
    for version, present in (("3.2.0", False), ("3.3.1", True), ("3.10.0+git1", True), ("4.0", True)):
        monkeypatch.setitem(sys.modules, "triton", types.SimpleNamespace(__version__=version))
        status = next(s for s in available_backends("cuda") if s.name == "cuda")
        assert status.present == present and version in status.reason
