"""The thesis's experiments, coarse and short: what they measure is physical, and what is written says what it is."""

from __future__ import annotations

import json
import sys
import warnings

import pytest
from paths import ROOT

if str(ROOT) not in sys.path:
    sys.path.append(str(ROOT))

from examples.figures.__main__ import draw, main
from examples.figures.material import Material
from examples.figures.record import alike, is_current
from examples.figures.registry import FIGURES

RESULTS = ROOT / "examples" / "figures" / "results"


@pytest.fixture(scope="module")
def material():
    return Material(fast=True)


@pytest.fixture
def made(material, tmp_path):
    """Makes a figure and returns its JSON."""

    def make(name):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            draw(FIGURES[name], material, tmp_path)
        picture = tmp_path / f"{name}.png"
        assert picture.read_bytes()[:4] == b"\x89PNG" and picture.stat().st_size < 150_000
        return json.loads((tmp_path / f"{name}.json").read_text(encoding="utf-8"))

    return make


def seen(content):
    return [claim["seen_here"] for claim in content["claims"]]


def test_phantom(made):
    numbers = made("phantom")["numbers"]
    assert 0.4 < numbers["peak_speed"] < 1.0
    assert numbers["flow_rate_error"] < 0.1


def test_segmentation(made):
    numbers = made("segmentation")["numbers"]
    assert numbers["longest_edge_of_hull"] > 3 * numbers["farthest_from_a_wall_point"]
    assert numbers["distance_from_true_wall"]["mean"] < 0.5e-3


def test_wedge(made):
    numbers = made("wedge")["numbers"]
    for wall in numbers.values():
        assert wall["outside"] == 0 and abs(wall["left_of_the_tip"] - 0.5) < 0.05
        assert abs(wall["front_fell"] - 0.5 * 9.81 * 0.2**2) < 0.03  # the top falls freely
    assert numbers["thesis"]["gap_in_spacings"] > numbers["default"]["gap_in_spacings"]


def test_smoothing(made):
    content = made("smoothing")
    numbers = content["numbers"]
    for row in numbers["kernel_alone"]:
        assert row["by_particles"] / row["by_kernels"] < 1.05  # no overshoot
        assert row["offset_cells"] < 0.2  # and no half cell
    assert numbers["spline"]["loose LSQR"][-1]["nrmse"] > 2 * numbers["spline"]["exact solver"][-1]["nrmse"]
    assert seen(content) == [True, False, False, True]


def test_panels(made):
    numbers = made("panels")["numbers"]
    for name in ("thesis", "default", "spline"):
        coarse, fine = numbers[name]
        assert fine["nrmse"] < coarse["nrmse"] < 1


def test_valves(made):
    numbers = made("valves")["numbers"]
    assert max(numbers["source_pressure"]["region 1"]) > 10  # Pa: the inlet drives
    assert not any(numbers["source_pressure"]["region 2"])  # the outlet is shut
    assert numbers["volume_error"]["default"] < 0.3 < numbers["volume_error"]["thesis"]


def test_forecasts(made):
    numbers = made("forecasts")["numbers"]
    for with_valves, without, still in zip(
        numbers["nrmse"]["default, with valves"],
        numbers["nrmse"]["default, without valves"],
        numbers["persistence"],
        strict=True,
    ):
        assert with_valves < 0.7 * still < without


def test_noise(made):
    found = made("noise")["numbers"]["nrmse"]
    assert found["ensemble, default"] < found["spline, default"] < found["raw"]
    assert found["spline, thesis"] < found["raw"]


def test_where(made):
    numbers = made("where")["numbers"]
    assert all(0 <= part <= 1 for part in numbers["squared_error_near_outlet"].values())
    assert 0 < numbers["nodes_near_outlet"] < 0.5


def test_sequences(made):
    texture = made("sequences")["numbers"]["texture"]
    assert texture["spline, default"] < 1.5 and min(texture.values()) > 0.1


def test_performance(made):
    rows = made("performance")["numbers"]["rows"]
    fewest, most = (
        next(r for r in rows if r["preset"] == "thesis" and r["smoothing_ratio"] == ratio and not r["xsph"])
        for ratio in (0.6, 1.1)
    )
    assert most["neighbours"] > 5 * fewest["neighbours"]
    assert all(row["particle_steps_per_s"] > 1e4 for row in rows)


def test_clustering(made):
    numbers = made("clustering")["numbers"]
    assert numbers["thesis"]["nearest_neighbour_p05"] < 0.6 * numbers["default"]["nearest_neighbour_p05"]
    assert numbers["default"]["volume_error"] < 0.02 < numbers["thesis"]["volume_error"]


@pytest.mark.slow  # a scanner and its calibration
def test_tracked(made):
    numbers = made("tracked")["numbers"]
    assert numbers["rms_error_axial"] < 0.5 * numbers["rms_error_lateral"]


def test_a_figure_that_is_current_is_not_drawn_again(material, tmp_path, monkeypatch):
    draw(FIGURES["phantom"], material, tmp_path)
    assert is_current(tmp_path / "phantom.json", fast=True)
    assert not is_current(tmp_path / "phantom.json", fast=False)
    monkeypatch.setattr("examples.figures.__main__.draw", lambda *_: pytest.fail("drawn again"))
    assert main(["phantom", "--fast", "--out", str(tmp_path)]) == 0


def test_later_code_that_gives_the_same_numbers_confirms_a_figure(material, tmp_path):
    draw(FIGURES["phantom"], material, tmp_path)
    file = tmp_path / "phantom.json"
    drawn = json.loads(file.read_text(encoding="utf-8"))
    older = drawn["from"] | {"code": "another", "commit": "before"}
    for check, current in ((drawn["numbers"], True), (drawn["numbers"] | {"more": 1.0}, False), (None, False)):
        file.write_text(json.dumps(drawn | {"fast": False, "check": check, "from": older}), encoding="utf-8")
        assert main(["phantom", "--confirm", "--out", str(tmp_path)]) == 0
        assert is_current(file, fast=False) == current
        found = json.loads(file.read_text(encoding="utf-8"))
        assert found["numbers"] == drawn["numbers"] and found["from"]["command"] == older["command"]
        assert found["from"].get("numbers of") == ("before" if current else None)


def test_what_counts_as_the_same_numbers():
    assert alike({"a": [1.0, "x", None, float("nan")]}, {"a": [1.0 + 1e-9, "x", None, float("nan")]})
    for other in ({"a": [1.001]}, {"a": [1.0, 1.0]}, {"b": [1.0]}, {"a": ["1.0"]}, [1.0]):
        assert not alike({"a": [1.0]}, other)


def test_every_figure_is_there():
    assert {file.stem for file in RESULTS.glob("*.json")} == set(FIGURES)


def test_results_say_what_they_are():
    for file in sorted(RESULTS.glob("*.json")):
        content = json.loads(file.read_text(encoding="utf-8"))
        assert content["figure"] in FIGURES, file.name
        assert len(content["from"]["commit"]) == 40
        assert all(claim["number"] and claim["observed_in_thesis"] for claim in content["claims"])
        assert file.with_suffix(".png").stat().st_size < 150_000
