"""The notebook runs, the pages' numbers are those of the results, and the programs and tests they name are there."""

from __future__ import annotations

import json
import re
import sys

import matplotlib
import pytest
from paths import ROOT

if str(ROOT) not in sys.path:
    sys.path.append(str(ROOT))

RESULTS = ROOT / "examples" / "benchmarks" / "results"


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def result(name: str):
    return json.loads((RESULTS / name).read_text(encoding="utf-8"))


def short(value: float) -> str:
    """.405"""
    return f"{value:.3f}".removeprefix("0")


def notebook() -> dict:
    return json.loads(text("examples/quickstart.ipynb"))


def test_the_notebook_runs_and_both_methods_take_noise_away(tmp_path, monkeypatch):
    """As it stands but for two of its four frames, and their numbers in the pictures."""
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    cells = {n: "".join(cell["source"]) for n, cell in enumerate(notebook()["cells"]) if cell["cell_type"] == "code"}
    for printed, quick in (("slice(10, 14)", "slice(11, 13)"), ("frame=2)", "frame=0)"), ("frame=3)", "frame=1)")):
        assert sum(printed in cell for cell in cells.values()) == 1
        cells = {number: cell.replace(printed, quick) for number, cell in cells.items()}
    for number, cell in cells.items():
        exec(compile(cell, f"quickstart.ipynb, cell {number}", "exec"), names)
    assert max(names["errors"]["ensemble"], names["errors"]["splines"]) < 0.8 * names["errors"]["measured"]
    assert (tmp_path / "analysis.h5").is_file()


def test_the_notebook_is_one_and_carries_no_outputs():
    nbformat = pytest.importorskip("nbformat", reason="pip install nbformat: validates the notebook's form")
    nbformat.validate(nbformat.from_dict(notebook()))
    assert not any(cell.get("outputs") for cell in notebook()["cells"])


def test_errors_of_the_methods_are_those_of_the_results():
    found = {noise: result(f"filter_methods_{noise}.json")["rows"] for noise in ("measured", "noisy")}
    settings, accuracy = text("torchsph/SETTINGS.md"), text("torchsph/ACCURACY.md")
    for method in ("ensemble", "spline", "free", "sph"):
        both = [short(found[noise][method]["nrmse"]) for noise in found]
        assert re.search(rf"`{method}`.*\| {re.escape(both[0])} / {re.escape(both[1])} \| ", settings)
    for method, name in (("raw", "measurement"), ("spline", "splines"), ("ensemble", "ensemble")):
        cells = []
        for noise in found:
            row = found[noise][method]
            value = short(row["nrmse"]) if row["nrmse"] < 1 else f"{row['nrmse']:.3f}"
            cells.append(f"{value}, {row['direction_error_deg']:.0f}°")
        assert f"| {name} | {cells[0]} | {cells[1]} |" in accuracy


def test_errors_over_spacing_and_members_are_those_of_the_results():
    settings = text("torchsph/SETTINGS.md")
    for row in result("speed_error.json")["rows"]:
        if row["flow"] == "ventricle" and row["curve"] == "projection":
            assert f"| {row['resolution']} | {short(row['error'])} | {row['cpu_s']:.1f} |" in settings
    for row in result("filter_sweeps.json")["rows"]:
        error, splines = short(row["nrmse"]["ensemble"]), short(row["nrmse"]["spline"])
        if row["sweep"].startswith("frame rate"):
            assert f"| {row['value']} Hz | {splines} | {error} |" in settings
        if row["sweep"] == "members":
            assert re.search(rf"^\| {row['value']}(?: \(default\))? \| {re.escape(error)} \| ", settings, re.MULTILINE)


def test_what_damage_costs_is_what_the_page_says():
    for noise in ("measured", "noisy"):
        for name, row in result(f"robustness_{noise}.json")["cases"].items():
            assert row["ensemble"] < row["spline"] < row["gaussian"], name
    cases = result("robustness_measured.json")["cases"]
    small, half = (
        100 * (cases[name]["ensemble"] / cases["as it is"]["ensemble"] - 1)
        for name in ("walls too small, .94", "half of the sector missing")
    )
    page = text("examples/STABILITY.md").replace("\n", " ")
    assert f"walls that are 6 % too small cost {small:.0f} % of error" in page
    assert f"half of a sector that is missing {half:.0f} %" in page


def test_hard_cases_of_the_page_are_tests():
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text("examples/STABILITY.md"))
    assert len(named) > 20
    assert not [f"{file}::{name}" for file, name in named if f"def {name}(" not in text(file)]


def test_every_hard_case_is_on_the_page():
    page = text("examples/STABILITY.md")
    for file in ("simulator/test_hard_cases.py", "assimilation/test_hard_cases.py"):
        for name in re.findall(r"^def (test_\w+)", text(f"tests/torchsph/{file}"), re.MULTILINE):
            assert name in page or "untuned_inflation" in name, name


def test_every_program_is_on_the_page():
    page = text("examples/README.md")
    assert not [f.name for f in (ROOT / "examples" / "programs").glob("*.py") if f"(programs/{f.name})" not in page]


def test_pages_that_are_written_are_current():
    from examples.figures.table import page as figures
    from examples.rivals.__main__ import TABLE, load
    from examples.rivals.__main__ import page as rivals

    assert text("examples/figures/README.md") == figures(ROOT / "examples" / "figures" / "results")
    assert text("examples/rivals/README.md") == rivals(load(TABLE))


def test_the_picture_of_the_readme_is_drawn_from_the_results_that_are_there():
    from PIL import Image

    from examples.error_seconds import forecasts, front, inputs_hash

    with Image.open(ROOT / "examples" / "error_seconds.png") as picture:
        assert picture.info["Comment"] == inputs_hash(), "redraw it: python examples/error_seconds.py"
    best = front(forecasts())
    assert all(a.seconds < b.seconds and a.error > b.error for a, b in zip(best, best[1:], strict=False))


def cells(values) -> str:
    """Numbers as the page of quantities shows them: two digits, three below a tenth."""
    shown = []
    for value in values:
        if value == 0:
            shown.append("0")
        else:
            text = f"{value:.3f}" if abs(value) < 0.1 else f"{value:.2f}"
            shown.append(text.removeprefix("0"))
    return " | ".join(shown)


def test_what_to_believe_is_what_was_measured():
    page = text("torchsph/haemodynamics/README.md")
    measured, noisy = (result(f"quantities_{noise}.json") for noise in ("measured", "noisy"))
    rows = {
        "kinetic energy": "kinetic_energy",
        "energy loss": "energy_loss",
        "size of the vorticity": "vorticity_rms",
        "axial force": "force_axial",
        "flow through the inlet": "flow_inlet",
        "flow through the outlet": "flow_outlet",
    }
    sources = ("formula", "raw", "spline", "ensemble", "members")
    for name, curve in rows.items():
        first = cells(measured["curves"][curve][source] for source in sources)
        held, other, also = (
            measured["coverage"][curve],
            noisy["curves"][curve]["members"],
            noisy["coverage"][curve],
        )
        assert f"| {name} | {first} | {held:.2f} | {cells([other])} | {also:.2f} |".replace("| 0.", "| .") in page, name
    for table, prefix in ((measured, ""), (noisy, "noisy: ")):
        found = table["pressure difference"]
        errors = cells(found[source]["error"] for source in (*sources, "simulator"))
        fits = " | ".join(f"{found[source]['correlation']:.3f}".removeprefix("0") for source in (*sources, "simulator"))
        assert f"| {prefix}base less apex, error | {errors} |" in page
        assert f"| {prefix}correlation | {fits} |" in page
        field = table["fields"]["pressure"]
        shown = [cells([field[source]]) if source in field else "" for source in (*sources, "simulator")]
        assert f"| {prefix}field, mean removed | {' | '.join(shown)} |" in page


def share(value: float) -> str:
    """How much a band holds: two digits."""
    return f"{value:.2f}".removeprefix("0")


PLANE_ROWS = (
    ("speed, RMS", "speed_rms"),
    ("kinetic energy", "kinetic_energy"),
    ("energy loss in the plane", "energy_loss"),
    ("size of the vorticity", "vorticity_rms"),
    ("circulation, positive", "circulation_positive"),
    ("circulation, negative", "circulation_negative"),
    ("strongest vortex, positive", "vortex_positive"),
    ("its area", "vortex_positive_area"),
    ("its depth", "vortex_positive_depth"),
    ("strongest vortex, negative", "vortex_negative"),
    ("its area", "vortex_negative_area"),
    ("its depth", "vortex_negative_depth"),
    ("wall shear in the plane", "wall_shear"),
    ("flow through the inlet", "flow_inlet"),
    ("flow through the outlet", "flow_outlet"),
)
DRAWN = (
    ("kinetic energy", "kinetic_energy"),
    ("energy loss", "energy_loss"),
    ("size of the vorticity", "vorticity_rms"),
    ("axial force", "force_axial"),
    ("flow through the outlet", "flow_outlet"),
)


def plane_row(name: str, curve: str, tables) -> str:
    """A row of the table of planes: both measurements, errors by source and what the bands hold."""
    shown = [name]
    for noise in ("measured", "noisy"):
        row = tables[f"lv_phantom_a_{noise}"][curve]
        shown += [cells(row[source] for source in ("raw", "splines", "ensemble", "members")), share(row["holds"])]
    return f"| {' | '.join(shown)} |"


def drawn_row(name: str, curve: str, *tables) -> str:
    """A row of the table of splines: the field's error, the draws' mean's, what their bands hold; both measurements."""
    shown = [name]
    for table in tables:
        errors = table["curves"][curve]
        shown += [cells([errors["spline"], errors["draws"]]), share(table["coverage of draws"][curve])]
    return f"| {' | '.join(shown)} |"


def test_what_is_read_out_of_a_plane_is_what_was_measured():
    page, tables = text("torchsph/haemodynamics/README.md"), result("planes.json")
    for name, curve in PLANE_ROWS:
        assert plane_row(name, curve, tables) in page, name


def test_what_draws_of_splines_are_worth_is_what_was_measured():
    page = text("torchsph/haemodynamics/README.md")
    both = [result(f"quantities_{noise}.json") for noise in ("measured", "noisy")]
    for name, curve in DRAWN:
        assert drawn_row(name, curve, *both) in page, name


RIVALS = {
    "**ensemble**, the default": "ensemble",
    "**splines** averaged over time (`smooth --over-time auto`)": "spline over time",
    "**splines**, frame by frame": "spline",
    "Helmholtz-Leray projection, averaged over time": "leray over time",
    "Gaussian in space and time": "gaussian over time",
    "constrained least squares, as iVFM has it": "ivfm",
    "the same, averaged over time": "ivfm over time",
    "neural field, a curl (SIREN)": "siren",
    "physics-informed network": "pinn",
    "learned denoiser": "denoiser",
    "Helmholtz-Leray projection": "leray",
    "`smoothn`, as PyMUST has it": "smoothn",
    "Gaussian": "gaussian",
    "the measurement": "raw",
}


def test_the_readme_shows_rivals_as_they_were_found():
    page, rows = text("README.md"), json.loads(text("examples/rivals/results/rivals.json"))["rows"]
    both = {name: [rows[noise].get(key) for noise in ("measured", "noisy")] for name, key in RIVALS.items()}
    expected = {name: pair for name, pair in both.items() if all(pair)}
    for name, (measured, noisy) in expected.items():
        found = (measured["nrmse"], noisy["nrmse"])
        errors = " | ".join(short(value) if value < 1 else f"{value:.2f}" for value in found)
        assert f"| {name} | {errors} | {measured['direction_error_deg']:.0f}° | " in page, name
    assert len(re.findall(r"^\| .* \| .*° \| ", page, re.MULTILINE)) == len(expected)
    words = page.replace("\n", " ")
    for noise, said in (("measured", "from {} (splines) to {}"), ("noisy", "from {} to {} at twice the noise")):
        pair = (f"{rows[noise][method]['nrmse']:.2f}".removeprefix("0") for method in ("spline", "ensemble"))
        assert said.format(*pair) in words
