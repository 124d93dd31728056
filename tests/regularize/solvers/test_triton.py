"""The Triton assembly against the torch reference: on a GPU if there is one, else under its interpreter."""

import importlib.util

import pytest
import torch
from regularize_cases import blocks_of

from regularize import InvalidInput, PreparedSystem, System, solve_direct

needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None,
    reason="triton is not installed (it comes with torch's CUDA builds): the assembly is not tested here",
)


@pytest.fixture(autouse=True)
def _interpreter(monkeypatch):
    if not torch.cuda.is_available():
        monkeypatch.setenv("TRITON_INTERPRET", "1")  # read when the kernel's module is first imported


@needs_triton
@pytest.mark.parametrize("kind", ["vector", "direction", "divergence", "all"])
@pytest.mark.parametrize("axes,degree", [(2, 3), (3, 1)])
def test_triton_band_equals_the_reference(axes, degree, kind):
    knots, blocks = blocks_of(axes, degree)
    chosen = list(blocks.values()) if kind == "all" else [blocks[kind]]
    system = System(knots, axes, chosen, 0.3)
    wanted = PreparedSystem(system, engine="reference").band()
    got = PreparedSystem(system, engine="triton").band()
    assert torch.allclose(got, wanted, rtol=1e-12, atol=1e-13 * float(wanted.abs().max()))


@needs_triton
def test_triton_cubic_solution_equals_the_reference():
    knots, blocks = blocks_of(3)
    system = System(knots, 3, [blocks["vector"], blocks["cell divergence"]], 0.3)
    solved = [solve_direct(PreparedSystem(system, engine=name))[0].x for name in ("triton", "reference")]
    assert torch.allclose(*solved, atol=1e-11)


def test_triton_without_a_gpu_or_an_interpreter_is_refused(monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    knots, blocks = blocks_of(2)
    with pytest.raises(InvalidInput, match="triton"):
        PreparedSystem(System(knots, 2, list(blocks.values()), 0.3), engine="triton")
