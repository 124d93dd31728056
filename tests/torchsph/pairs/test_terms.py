"""The table of pair terms: what is planned from it is compiled, and no backend tells another story."""

from __future__ import annotations

import ast
import ctypes
import dataclasses
import itertools
import re
import subprocess
import sys
from pathlib import Path

import pytest

from torchsph.native import headers
from torchsph.native.library import LibraryMissing, library
from torchsph.native.structures import PassArguments
from torchsph.pairs import MomentumTerms, Rates, RateTerms, backends, terms
from torchsph.pairs.backends import plan
from torchsph.pairs.smoothing_kernels import NUMBERS

TRITON = Path(backends.__file__).with_name("triton_kernels.py")
SWITCHES = [term.name for term in terms.TERMS if term.kind != terms.ACCELERATION and term.name != "continuity"]


def all_rates():
    """Every request for rates that is allowed; the Laplacian is asked for in another way."""
    names = [name for name in SWITCHES if name != "laplacian"]
    for form, *switches in itertools.product(("volume", "mass", None), *[(False, True)] * len(names)):
        asked = dict(zip(names, switches, strict=True))
        if not (asked["diffusion"] and asked["corrected_diffusion"]):
            yield RateTerms(form, **asked)


def all_forces():
    for form, artificial, laminar, tensile in itertools.product((*terms.PRESSURE_FORMS, None), *[(None, 0.1)] * 3):
        if tensile is None or form == "symmetric":
            yield MomentumTerms(form, artificial, laminar, tensile)


def all_passes():
    """Every pass that any request leads to, once: terms, weight."""
    passes = {(plan.LAPLACIAN, terms.BY_VOLUME)}
    for rates in all_rates():
        passes |= {(p.terms, p.weight) for p in plan.rate_passes(rates)}
    passes |= {(p.terms, p.weight) for p in map(plan.force_pass, all_forces()) if p is not None}
    return sorted(passes)


def shared_passes():
    """Those in which rates and forces share a loop."""
    few = [rates for rates in all_rates() if not any(getattr(rates, n) for n in ("gradient", "moments"))]
    found = (plan.shared_passes(rates, forces) for rates in few for forces in all_forces())
    return sorted({(p.terms, p.weight) for passes in found if passes is not None for p in passes})


def test_requests_and_results_are_those_of_the_table():
    switches = {field.name for field in dataclasses.fields(RateTerms)} - {"continuity"}
    assert switches == set(SWITCHES) - {"laplacian"}
    sums = [field.name for field in dataclasses.fields(Rates)]
    assert sums == [o.name for o in terms.OUTPUTS if o.name not in ("acceleration", "laplacian", "diagonal")]


def test_the_table_is_closed():
    names = [term.name for term in terms.TERMS]
    assert len(set(names)) == len(names) and {name: 2**bit for bit, name in enumerate(names)} == terms.FLAGS
    assert all(field in terms.FIELDS for term in terms.TERMS for field in term.reads)
    filling = {name for output in terms.OUTPUTS for name in output.terms}
    assert filling == set(names) - {"tensile"}  # which changes the pressure's sum and has none of its own
    # C++ makes a table of all combinations of these: they have to be the lowest flags
    combined = terms.of_kind(terms.RATE) | terms.of_kind(terms.ACCELERATION)
    assert combined & (combined + 1) == 0


@pytest.mark.parametrize("passes", [all_passes, shared_passes])
def test_every_planned_pass_has_one_weight_and_is_compiled(passes):
    try:
        code = library()
    except LibraryMissing as missing:
        pytest.skip(str(missing))
    pointers = (ctypes.c_void_p * len(terms.OUTPUTS))()
    wide = code.instruction_set != "baseline"
    for flags, weight in passes():
        for term in terms.TERMS:
            assert not flags & terms.FLAGS[term.name] or weight in term.weights, f"{term.name} in {flags:#x}"
        for reals in ("f32", "f64") if passes is all_passes else ("f32",) * wide:
            nothing = PassArguments(dimension=3, threads=1, terms=flags, outputs=ctypes.addressof(pointers))
            assert code.function("pass", reals)(ctypes.byref(nothing)) == 0, f"{flags:#x} {reals}"


def test_no_pass_holds_two_terms_of_one_sum():
    """But for accelerations, which add up; two others in one register would be silently mixed."""
    for flags, _ in (*all_passes(), *shared_passes()):
        for output in terms.OUTPUTS:
            held = [name for name in output.terms if flags & terms.FLAGS[name]]
            assert len(held) <= 1 or output.name == "acceleration", f"{flags:#x}: {held} in {output.name}"


def test_every_sum_has_its_own_register_in_triton():
    """A register that a term writes is the sum that the table gives it, and no other term writes there."""
    found: dict[str, set[str]] = {}
    for function in ast.parse(TRITON.read_text(encoding="utf-8")).body:
        if not isinstance(function, ast.FunctionDef) or not function.name.startswith("add_"):
            continue
        for branch in (node for node in function.body if isinstance(node, ast.If)):
            flags = {node.id.lower() for node in ast.walk(branch.test) if isinstance(node, ast.Name)} - {"terms"}
            for name in (node.id for node in ast.walk(branch) if isinstance(node, ast.Name)):
                stored = any(
                    isinstance(node, ast.Name) and node.id == name and isinstance(node.ctx, ast.Store)
                    for node in ast.walk(branch)
                )
                if stored and name in {output.name for output in terms.OUTPUTS}:
                    found.setdefault(name, set()).update(flags)
    assert found == {output.name: set(output.terms) for output in terms.OUTPUTS}


@pytest.mark.parametrize("name", sorted(NUMBERS))
def test_every_smoothing_kernel_has_its_branch_by_name(name):
    cpp = (headers.CSRC / "smoothing.hpp").read_text(encoding="utf-8")
    assert re.search(rf"case {name}:|kernel == {name}\b", cpp)
    triton = TRITON.with_name("triton_smoothing.py").read_text(encoding="utf-8")
    assert re.search(rf"KERNEL == {name.upper()}\b", triton)
    assert not re.search(r"(KERNEL|kernel) [=<>]+ \d", cpp + triton)


def test_headers_are_written_without_torch():
    """As the PEP 517 backend does, in an environment of its own: -S hides what is installed."""
    code = "import runpy, sys; print(len(runpy.run_path(sys.argv[1])['headers']()), 'torch' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-S", "-c", code, headers.__file__], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["2", "False"]
