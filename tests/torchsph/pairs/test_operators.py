"""The compiled kernels as torch operators, the choice among libraries and backends, what their errors say."""

from __future__ import annotations

import dataclasses
import itertools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from pair_cases import as_dtype, assert_close, disordered, support

import torchsph
from regularize.native import loader
from torchsph.native import build
from torchsph.native import library as native
from torchsph.pairs import MomentumTerms, RateTerms, ReferenceBackend, available_backends, choose_backend, registry
from torchsph.pairs.backends import cpu_operators as operators
from torchsph.pairs.backends import plan
from torchsph.pairs.smoothing_kernels import SmoothingKernel, truncated_gaussian

CPU = next(status for status in available_backends() if status.name == "cpu")
needs_cpu = pytest.mark.skipif(not CPU.present, reason=CPU.reason)


@needs_cpu
class TestOperators:
    """torch's own checks: schema, no aliasing, fake shapes equal to the real ones."""

    checks = ("test_schema", "test_faketensor", "test_autograd_registration")

    def test_search(self):
        state = disordered(5, 3, torch.float32)
        entries = torch.empty(9000, dtype=torch.int32)
        arguments = (state.position, state.member, 2.4, [float("inf")] * 3, entries)
        torch.library.opcheck(operators.cluster_lists, arguments, test_utils=self.checks)

    def test_pass(self):
        state = disordered(5, 3, torch.float32)
        lists = choose_backend("cpu").search(state.position, state.member, 2.4).lists
        terms = plan.CONTINUITY | plan.CONCENTRATION | plan.PRESSURE
        coefficients = torch.tensor([[1.2, 0.0, 0.0, 0.0]], dtype=torch.float64)
        arrays = (
            state.position,
            state.velocity,
            state.mass,
            state.deviation,
            state.pressure,
            None,
            None,
            None,
        )
        arguments = (
            lists,
            [float("inf")] * 3,
            [plan.CONTINUITY | plan.CONCENTRATION, 0, 0, 0],
            [2.0, 0.4],
        )
        torch.library.opcheck(operators.pair_pass, (*arguments, coefficients, *arrays), test_utils=self.checks)
        assert plan.Pass(terms, 0).outputs == ["divergence", "concentration", "acceleration"]

    def test_interpolation(self):
        state = disordered(5, 2, torch.float64)
        lengths = torch.tensor([1.2], dtype=torch.float64)
        arguments = (
            state.position,
            state.member,
            state.velocity,
            state.position[:9] + 0.1,
            state.member[:9],
            2.4,
            [float("inf")] * 2,
            0,
            [2.0, 0.4],
            lengths,
        )
        torch.library.opcheck(operators.interpolation_moments, arguments, test_utils=self.checks)

    def test_combination_that_is_not_compiled(self):
        state = disordered(4, 3)
        lists = choose_backend("cpu").search(state.position, state.member, 2.4).lists
        coefficients = torch.ones((1, 4), dtype=torch.float64)
        arrays = (state.position, state.velocity, state.mass, state.deviation, None, None, None, None)
        terms = plan.SHEPARD | plan.XSPH
        with pytest.raises(NotImplementedError, match="0x108"):
            operators.pair_pass(lists, [float("inf")] * 3, [terms, 0, 0, 0], [2.0, 0.4], coefficients, *arrays)


@needs_cpu
def test_first_search_does_not_wait_for_the_compiler_of_torch(tmp_path):
    """Calling an operator must not import torch._dynamo, which takes seconds."""
    lines = (
        "import sys, torch",
        "from torchsph.pairs import choose_backend",
        "x = torch.rand(50, 3)",
        "choose_backend('cpu').search(x, torch.zeros(50, dtype=torch.int64), 0.3)",
        "sys.exit('torch._dynamo' in sys.modules)",
    )
    # the package that is tested here, which is the installed one where there is one, not the working directory's
    environment = os.environ | {"PYTHONPATH": str(Path(torchsph.__file__).parents[1])}
    command = [sys.executable, "-c", "; ".join(lines)]
    assert subprocess.run(command, env=environment, cwd=tmp_path, check=False).returncode == 0


@needs_cpu
class TestWrongInputs:
    def pairs(self, state):
        return choose_backend("cpu").search(state.position, state.member, 2.4)

    def test_mixed_precision(self):
        state = disordered(4, 3, torch.float32)
        pairs = self.pairs(state)
        mixed = dataclasses.replace(state, velocity=state.velocity.double())
        with pytest.raises(TypeError, match="all arrays in float32 or all in float64"):
            choose_backend("cpu").rates(pairs, mixed, support("cubic", 3), RateTerms())

    def test_half_precision(self):
        state = disordered(4, 3, torch.float16)
        with pytest.raises(TypeError, match="float16"):
            self.pairs(state)

    def test_gradient_wanted(self):
        state = disordered(4, 3)
        with pytest.raises(ValueError, match="not differentiable; .* backend='reference'"):
            choose_backend("cpu").search(state.position.requires_grad_(), state.member, 2.4)

    def test_state_of_another_size(self):
        state, other = disordered(4, 3), disordered(5, 3)
        with pytest.raises(ValueError, match="pairs are of 64 particles and the state of 125"):
            choose_backend("cpu").rates(self.pairs(state), other, support("cubic", 3), RateTerms())

    def test_kernel_that_is_not_compiled(self):
        own = SmoothingKernel("own", 2.0, lambda q: q, lambda q: q, {3: 1.0}, "nowhere")
        state = disordered(4, 3)
        choice = type(support("cubic", 3))(own, 1.2, 3)
        with pytest.raises(ValueError, match="no kernel 'own' compiled in; use backend='reference'"):
            choose_backend("cpu").rates(self.pairs(state), state, choice, RateTerms())

    def test_kernel_of_a_known_name_and_another_formula(self):
        own = SmoothingKernel("cubic", 2.0, lambda q: q, lambda q: q, {3: 1.0}, "nowhere")
        state = disordered(4, 3)
        with pytest.raises(ValueError, match="no kernel 'cubic' compiled in"):
            choose_backend("cpu").rates(self.pairs(state), state, type(support("cubic", 3))(own, 1.2, 3), RateTerms())

    def test_smoothing_length_of_each_particle(self):
        state = disordered(4, 3)
        choice = dataclasses.replace(
            support("cubic", 3), length=torch.full((64,), 1.2, dtype=torch.float64), per_particle=True
        )
        with pytest.raises(ValueError, match="one smoothing length per member; use backend='reference'"):
            choose_backend("cpu").rates(self.pairs(state), state, choice, RateTerms())

    def test_tensile_distance_outside_the_support(self):
        state = disordered(4, 3)
        terms = MomentumTerms("symmetric", tensile=0.2, tensile_distance=5.0)
        with pytest.raises(ValueError, match="lies outside the kernel's support"):
            choose_backend("cpu").momentum(self.pairs(state), state, support("cubic", 3), terms)


@needs_cpu
def test_gaussian_of_another_truncation():
    state = disordered(6, 3)
    choice = type(support("cubic", 3))(truncated_gaussian(2.5), 0.9, 3)
    fast, reference = choose_backend("cpu"), ReferenceBackend()
    got = fast.rates(fast.search(state.position, state.member, choice.radius), state, choice, RateTerms(shepard=True))
    pairs = reference.search(state.position, state.member, choice.radius)
    wanted = reference.rates(pairs, state, choice, RateTerms(shepard=True))
    torch.testing.assert_close(got.shepard_mass, wanted.shepard_mass, rtol=1e-12, atol=0)
    torch.testing.assert_close(got.divergence, wanted.divergence, rtol=1e-12, atol=1e-12)


class TestChoice:
    def test_best_present_comes_first(self):
        best = next(status for status in available_backends() if status.present)
        assert choose_backend("auto").name == best.name
        assert available_backends()[-1].name == "reference" and available_backends()[-1].present

    def test_unknown_name(self):
        with pytest.raises(ValueError, match="unknown backend 'warp'; known: auto, .*cpu, reference"):
            choose_backend("warp")

    def test_cpu_backend_for_another_device(self):
        with pytest.raises(ValueError, match="'cpu' was asked for and cannot be used: .*device asked for is 'cuda'"):
            choose_backend("cpu", "cuda")

    def test_without_libraries(self, monkeypatch, tmp_path):
        monkeypatch.setattr(build, "LIBRARIES", tmp_path)
        native.library.cache_clear()
        try:
            status = next(s for s in available_backends() if s.name == "cpu")
            assert not status.present and "python -m torchsph.native.build" in status.reason
            assert choose_backend("auto").name == "reference"
            with pytest.raises(ValueError, match="found no C\\+\\+ compiler.*reinstall"):
                choose_backend("cpu")
        finally:
            monkeypatch.undo()
            native.library.cache_clear()

    def test_library_that_cannot_be_loaded(self, monkeypatch, tmp_path):
        monkeypatch.setattr(build, "LIBRARIES", tmp_path)
        native.family().path("baseline").write_bytes(b"not a library")
        native.library.cache_clear()
        try:
            with pytest.raises(ValueError, match="cannot be loaded.*rebuild with"):
                registry.choose_backend("cpu")
        finally:
            monkeypatch.undo()
            native.library.cache_clear()

    def test_unknown_instruction_set(self, monkeypatch):
        if not CPU.present:
            pytest.skip(CPU.reason)
        monkeypatch.setenv(native.FORCED, "avx1024")
        native.library.cache_clear()
        try:
            with pytest.raises(ValueError, match="TORCHSPH_ISA=avx1024 is unknown; known: avx512, avx2, baseline"):
                choose_backend("cpu")
        finally:
            monkeypatch.undo()
            native.library.cache_clear()


@needs_cpu
def test_an_instruction_set_that_this_processor_lacks(monkeypatch):
    """Forced by name it is refused with the cure; left alone the next best library is taken."""
    load = loader.load

    class Poor:
        """A library that says of this processor that it runs the baseline only."""

        def __init__(self, family, instruction_set):
            self._library = load(family, instruction_set)

        def __getattr__(self, name):
            return getattr(self._library, name)

        @staticmethod
        def sph_runs(name):
            return name == b"baseline"

    monkeypatch.setattr(loader, "load", Poor)
    native.library.cache_clear()
    try:
        assert choose_backend("auto").instruction_set == "baseline"
        monkeypatch.setenv(native.FORCED, "avx512")
        native.library.cache_clear()
        with pytest.raises(ValueError, match="TORCHSPH_ISA=avx512 asks for instructions that this processor lacks"):
            choose_backend("cpu")
    finally:
        monkeypatch.undo()
        native.library.cache_clear()


@needs_cpu
@pytest.mark.parametrize("instruction_set", native.PREFERENCE)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_instruction_set_equals_the_reference(instruction_set, dtype, monkeypatch):
    if not native.library().handle.sph_runs(instruction_set.encode()):
        pytest.skip(f"this processor lacks {instruction_set}: its library cannot be run here")
    monkeypatch.setenv(native.FORCED, instruction_set)
    native.library.cache_clear()
    try:
        fast = choose_backend("cpu")
        assert fast.instruction_set == instruction_set
        for dimension, name in itertools.product((2, 3), ("wendland_c2", "gaussian", "quintic")):
            compare_with_reference(fast, dimension, name, dtype)
    finally:
        monkeypatch.undo()
        native.library.cache_clear()


def compare_with_reference(fast, dimension: int, name: str, dtype: torch.dtype) -> None:
    state = disordered(12 if dimension == 2 else 7, dimension, dtype)
    choice, reference, wide = (
        support(name, dimension, 1.1),
        ReferenceBackend(),
        as_dtype(state, torch.float64),
    )
    pairs = fast.search(state.position, state.member, choice.radius)
    wanted_pairs = reference.search(wide.position, wide.member, choice.radius)
    rates = RateTerms("volume", True, False, True, True, True)
    forces = MomentumTerms("switched", 0.1, 0.2)
    got = fast.right_hand_side(pairs, state, choice, rates, forces)
    wanted = reference.right_hand_side(wanted_pairs, wide, choice, rates, forces)
    assert_close(got[0], wanted[0], dtype)
    assert_close(got[1], wanted[1], dtype)
    query = state.position + 0.2
    got = fast.interpolate(state.position, state.member, state.velocity, choice, query, state.member)
    wanted = reference.interpolate(wide.position, wide.member, wide.velocity, choice, query.double(), wide.member)
    assert_close(got, wanted, dtype)


def test_no_compiler_builds_nothing(monkeypatch, tmp_path):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert build.build(tmp_path) == []


def test_compiler_that_fails_is_reported(monkeypatch, tmp_path):
    if not shutil.which("g++"):
        pytest.skip("no C++ compiler on this machine")
    for part in build.PARTS:
        (tmp_path / part.source).write_text("#error this machine is out of order\n")
    with pytest.raises(build.BuildError, match="out of order"):
        build.build(tmp_path / "out", source=tmp_path)


def test_missing_sources_are_reported(tmp_path):
    if not shutil.which("g++"):
        pytest.skip("no C++ compiler on this machine")
    with pytest.raises(FileNotFoundError, match="pairs.cpp is missing; reinstall"):
        build.build(tmp_path, source=tmp_path)
