"""The page of a run as a file: complete, closed to text that would be markup, and no larger than allowed."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace

import numpy as np
import pytest

import geometry
import torchsph
from torchsph.evaluation import metrics
from torchsph.report import LARGEST, write_report
from torchsph.report.packing import packed, packed_places

HOSTILE = '</script><script>alert(1)</script><img src=x onerror="alert(2)">\u2028{{DATA}}<!--'
OMEGA = 30.0  # 1/s


def turning(points: np.ndarray, time: float) -> np.ndarray:
    """A rigid rotation about z through the middle of the box, m/s."""
    away = points - 0.005
    field = np.zeros_like(points)
    field[:, 0], field[:, 1] = -OMEGA * away[:, 1], OMEGA * away[:, 0]
    return field


def data_of(page: str) -> dict:
    """The data that a page carries."""
    found = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert len(found) == 1
    return json.loads(found[0])


def numbers(array: dict) -> np.ndarray:
    """A packed array as the page's script reads it."""
    raw = np.frombuffer(
        base64.b64decode(array["values"]), {"int16": "<i2", "uint16": "<u2", "uint8": "u1"}[array["kind"]]
    )
    return raw.reshape(array["shape"]) * array["step"] + array["base"]


def written(path, *args, **options) -> str:
    size = write_report(path, *args, **options)
    assert size == path.stat().st_size <= LARGEST
    return path.read_text(encoding="utf-8")


def test_it_is_one_closed_file(tmp_path, box_recording):
    page = written(tmp_path / "page.html", box_recording(turning))
    assert "for research, not for clinical use" in page
    assert not re.search(r"(src|href)\s*=\s*[\"']?(?!data:)", page.replace('href="data:,"', ""))
    assert not re.search(r"https?://|@import|url\(|fetch\(|XMLHttpRequest|WebSocket|innerHTML|eval\(", page)
    policy = re.findall(r'Content-Security-Policy" content="(.*?)"', page)[0]
    assert policy.startswith("default-src 'none'")
    for tag in ("script", "style"):
        content = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        assert len(content) == 1
        digest = base64.b64encode(hashlib.sha256(content[0].encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy


def test_no_text_of_a_file_becomes_markup(tmp_path, box_recording):
    recording = box_recording(turning, description=HOSTILE)
    plain = written(tmp_path / "plain.html", box_recording(turning))
    page = written(
        tmp_path / "page.html",
        recording,
        recording,
        name=HOSTILE,
        title=HOSTILE,
        notes=[HOSTILE],
        account={HOSTILE: {HOSTILE: [HOSTILE, float("nan")]}},
        quantities={"time": [0, 0.01, 0.02], "units": {HOSTILE: HOSTILE}, "curves": {HOSTILE: {HOSTILE: [1, None, 2]}}},
    )
    assert page.count("<script") == plain.count("<script") == 2
    assert "<img" not in page and "alert(1)</script>" not in page and "<!--" not in page
    data = data_of(page)
    assert data["title"] == data["notes"][0] == data["about"][0] == HOSTILE
    assert data["account"][HOSTILE][HOSTILE] == [HOSTILE, "nan"]
    assert data["curves"][0]["lines"][0]["values"] == [1, None, 2]


def test_planes_hold_the_flow_and_its_vorticity(tmp_path, box_recording):
    recording = box_recording(turning, valve_intervals=np.array([[1, 0.0, 0.01]]))
    recording = replace(recording, sigma=np.full_like(recording.velocity, 0.02))
    data = data_of(written(tmp_path / "page.html", recording, recording))
    assert data["valves"] == [{"region": 1, "opens": 0.0, "closes": 0.01}]
    assert len(data["planes"]) == 3
    for plane in data["planes"]:
        origin, across, along = (np.array(axis) for axis in plane["axes"])
        fields = {name: numbers(field) for name, field in plane["fields"]["analysis"].items()}
        ns, nt = plane["size"]
        s = plane["corner"][0] + plane["pixel"] * np.arange(ns)
        t = plane["corner"][1] + plane["pixel"] * np.arange(nt)
        points = origin + s[None, :, None] * across + t[:, None, None] * along
        nodes = np.array([0.5, 7.5]) * 0.01 / 8  # between the outermost nodes of the blood
        inner = ((points > nodes[0]) & (points < nodes[1])).all(-1)
        assert inner.sum() > 20
        axes = np.stack([across, along, np.cross(across, along)])
        expected = np.einsum("ad,jid->aji", axes, turning(points.reshape(-1, 3), 0.0).reshape(points.shape))
        for frame in range(3):
            np.testing.assert_allclose(fields["velocity"][frame][:, inner], expected[:, inner], atol=2e-5)
            np.testing.assert_allclose(fields["vorticity"][frame][inner], 2 * OMEGA * axes[2, 2], atol=0.01)
            np.testing.assert_allclose(fields["deviation"][frame][inner], 0.02 * 3**0.5, rtol=1e-4)
        assert fields["known"][:, inner].all()


def test_the_wall_is_cut_with_its_orifices(tmp_path, box_recording):
    planes = data_of(written(tmp_path / "page.html", box_recording(turning)))["planes"]
    for plane in planes:
        outline = plane["outline"]
        places, region = numbers(outline["places"]), numbers(outline["region"])
        assert outline["first"] == [0, len(region) // 3, 2 * len(region) // 3, len(region)]
        assert set(np.unique(region)) <= {0, 1}
        s0, t0, s1, t1 = places[: len(region) // 3].T
        for t in t0.min() + np.array([0.137, 0.411, 0.713, 0.931]) * np.ptp(t0):
            crossings = int(((t0 > t) != (t1 > t)).sum())
            assert crossings >= 2 and crossings % 2 == 0  # closed: the page's even-odd rule finds the blood
    assert (numbers(planes[0]["outline"]["region"]) == 1).any()  # the plane through the orifice


@pytest.mark.slow
def test_a_large_recording_is_thinned_and_says_so(tmp_path, box_recording):
    recording = box_recording(turning, nodes=26, times=tuple(0.001 * n for n in range(300)))
    data = data_of(written(tmp_path / "page.html", recording, recording, tracers=50))
    assert len(data["time"]) == 120 and data["time"][0] == 0 and data["time"][-1] == pytest.approx(0.299)
    assert "120 of 300 frames" in data["about"][-1]
    assert data["planes"][0]["pixel"] > 0.01 / 26 * (1 + 1e-9)


def test_planes_holes_and_no_wall(tmp_path, box_recording):
    """A plane recording, one without walls, and a measurement in part of the blood are shown as far as they go."""
    flat = box_recording(lambda points, time: np.stack([-points[:, 1], points[:, 0]], 1), dimension=2)
    assert len(data_of(written(tmp_path / "flat.html", flat))["planes"]) == 1
    bare = data_of(written(tmp_path / "bare.html", replace(box_recording(turning), wall=None)))
    assert all(plane["outline"] is None for plane in bare["planes"]) and bare["paths"] is not None
    whole = box_recording(turning)
    weight = np.asarray(whole.mask, np.float32).copy()
    weight[:, :, :, :5] = 0
    fields = data_of(written(tmp_path / "part.html", whole, replace(whole, weight=weight)))["planes"][2]["fields"]
    known = {name: numbers(field["known"]).mean() for name, field in fields.items()}
    assert 0.2 < known["measurement"] < 0.8 * known["analysis"]
    still = data_of(written(tmp_path / "one.html", whole.select([1])))
    assert still["paths"] is None and len(still["time"]) == 1


def test_the_table_and_curves_of_measures(tmp_path, box_recording):
    truth = box_recording(turning)
    half = truth.with_velocity(0.5 * truth.velocity)
    scores = {name: metrics.evaluate(each, truth, truth) for name, each in (("raw", truth), ("half", half))}
    page = written(tmp_path / "page.html", half, truth, truth=truth, scores=scores, seconds={"half": 2.0})
    data = data_of(page)
    assert data["table"][0][:2] == ["method", "nrmse"] and data["table"][2][1] == "0.5"
    error = next(curve for curve in data["curves"] if curve["name"] == "Error of the velocity")
    assert [line["label"] for line in error["lines"]] == ["raw", "half"]
    np.testing.assert_allclose(error["lines"][1]["values"], 0.5, rtol=1e-4)
    assert list(data["planes"][0]["fields"]) == ["analysis", "measurement", "truth"]


def test_recordings_that_do_not_fit_are_refused(tmp_path, box_recording):
    recording = box_recording(turning)
    with pytest.raises(ValueError, match="the measurement has a grid of"):
        write_report(tmp_path / "page.html", recording, box_recording(turning, nodes=6))
    with pytest.raises(ValueError, match="the truth has no frame at"):
        write_report(tmp_path / "page.html", recording, truth=recording.select([0]))
    assert not (tmp_path / "page.html").exists()


def test_the_same_page_twice(tmp_path, box_recording):
    first, second = (written(tmp_path / name, box_recording(turning)) for name in ("a.html", "b.html"))
    assert first == second
    assert torchsph.write_report is write_report


def test_numbers_are_kept_to_their_step():
    values = np.array([-3.0, 0.0, 1e-9, 2.5, np.nan])
    kept = packed(values)
    back = numbers(kept)
    np.testing.assert_allclose(back[:4], values[:4], atol=0.5 * kept["step"])
    assert back[1] == 0 and back[4] == -32768 * kept["step"] and kept["step"] == 3 / 32000
    places = packed_places(values[:4])
    np.testing.assert_allclose(numbers(places), values[:4], atol=0.5 * 5.5 / 65535)
    assert numbers(packed(np.zeros(3))).tolist() == [0, 0, 0]


def test_a_recording_of_its_own_kind_is_read_back(tmp_path, box_recording):
    """What a page is made of may come from a file as well."""
    geometry.write_recording(tmp_path / "a.h5", box_recording(turning))
    written(tmp_path / "page.html", geometry.read_recording(tmp_path / "a.h5"))
