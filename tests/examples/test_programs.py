"""The short programs say what they promise: each prints one number, which is checked here."""

from __future__ import annotations

import ast
import runpy

import pytest
from paths import ROOT

PROGRAMS = ROOT / "examples" / "programs"
NUMBERS = {
    "periodic_box": (0.99, 1.01),  # exact: 1
    "dam_break": (0.0, 0.08),  # of the front that Martin and Moyce measured
    "pipe": (0.0, 0.01),  # 10 particles across
    "own_surface": (0.97, 1.03),  # what enters leaves
    "own_wall_model": (0.3, 0.9),  # a sticky wall takes energy, and never gives any
    "own_filter": (0.153, 0.207),  # published: .18, Sakov and Oke 2008; 15 % either way
    "own_forecast_model": (0.0, 0.15),
    "other_measurement": (0.2, 0.6),  # of zero velocities: 1
    "forecast": (0.3, 0.65),  # of persistence: 1
    "quantify": (0.5, 0.95),  # energies of smoothed fields are too low
}


@pytest.mark.parametrize("name", NUMBERS)
def test_a_program_computes_what_it_says(name):
    low, high = NUMBERS[name]
    assert low <= runpy.run_path(str(PROGRAMS / f"{name}.py"))["main"]() <= high


def test_every_program_is_checked():
    assert {path.stem for path in PROGRAMS.glob("*.py")} == set(NUMBERS)


@pytest.mark.parametrize("name", NUMBERS)
def test_a_program_can_be_read_at_one_go(name):
    tree = ast.parse((PROGRAMS / f"{name}.py").read_text(encoding="utf-8"))
    main = next(node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "main")
    assert (main.end_lineno or 0) - main.lineno <= 22
    assert ast.get_docstring(tree)
