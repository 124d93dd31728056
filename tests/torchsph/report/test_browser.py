"""The page in a browser: nothing fails, nothing is fetched, and everything can be reached and used.

Needs Chromium and the Python package playwright (`pip install playwright`; its own browsers are not needed).
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from torchsph.report import write_report

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking")
HOSTILE = '</script><img src=x onerror="window.broken = 1"><b>'

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: the page was not tried in one")
sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright: the page was not tried in a browser")


class Page:
    """An open page, and all that went wrong in it."""

    def __init__(self, browser, path, width: int, height: int) -> None:
        self.tab = browser.new_page(viewport={"width": width, "height": height})
        self.faults: list[str] = []
        self.requests: list[str] = []
        self.tab.on("console", lambda message: self.faults.append(message.text))
        self.tab.on("pageerror", lambda fault: self.faults.append(str(fault)))
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.address = path.as_uri()
        self.tab.goto(self.address)

    def value(self, expression: str):
        return self.tab.evaluate(expression)

    def shows(self, words: str) -> None:
        """Wait until the time says so. (The page's policy forbids what playwright's own waiting evaluates.)"""
        for _ in range(200):
            if words in self.value("document.getElementById('now').textContent"):
                return
            self.tab.wait_for_timeout(50)
        pytest.fail(f"the page never came to {words}")

    def picture(self, number: int = 0) -> str:
        """What a plane's canvas shows, as text to compare."""
        return self.value(f"document.querySelectorAll('#planes canvas')[{number}].toDataURL()")


@pytest.fixture(scope="module")
def browser() -> Iterator:
    with sync_api.sync_playwright() as play:
        found = play.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield found
        found.close()


def swirl(points: np.ndarray, time: float) -> np.ndarray:
    away = points - 0.005
    return 40 * (1 + 20 * time) * np.stack([-away[:, 1], away[:, 0], 0.3 * away[:, 2]], 1)


@pytest.fixture
def opened(tmp_path, browser, box_recording) -> Iterator[Callable[..., Page]]:
    """Opens the page of a small flow that has everything, with hostile text wherever text can stand."""
    recording = box_recording(
        swirl, times=tuple(0.01 * n for n in range(5)), valve_intervals=np.array([[1, 0.0, 0.02]]), description=HOSTILE
    )
    analysis = replace(
        recording,
        sigma=np.full_like(recording.velocity, 0.03),
        pressure=np.linspace(-50, 80, recording.mask.size, dtype=np.float32).reshape(recording.mask.shape),
    )
    band = [1.0, 2.0, 3.0, 2.0, 1.0]
    members = {"mean": band, "low": [0.5 * x for x in band], "high": [1.5 * x for x in band]}
    quantities = {
        "time": recording.time.tolist(),
        "units": {"energy_loss": "W"},
        "curves": {"analysis": {"energy_loss": band}},
        "members": {"curves": {"energy_loss": members}},
        "beat": {"analysis": {"energy_lost": 2.0}},
    }
    write_report(
        tmp_path / "page.html",
        analysis,
        recording,
        title=HOSTILE,
        name="ensemble",
        quantities=quantities,
        account={HOSTILE: HOSTILE, "settings": {"seed": 0}},
        notes=[HOSTILE],
        tracers=60,
    )
    pages: list[Page] = []

    def open_(width: int = 1280, height: int = 900) -> Page:
        pages.append(Page(browser, tmp_path / "page.html", width, height))
        return pages[-1]

    yield open_
    for page in pages:
        assert page.faults == []
        assert page.requests == [page.address]
        page.tab.close()


def test_text_of_files_is_text(opened):
    page = opened()
    assert page.value("window.broken") is None and page.value("document.images.length") == 0
    assert page.value("document.title") == HOSTILE
    assert page.value("document.querySelector('#about p').textContent") == HOSTILE
    assert page.value("document.querySelector('#account dt').textContent") == HOSTILE


def test_the_slider_moves_time_and_the_planes(opened):
    page = opened()
    first = page.picture()
    page.tab.focus("#time")
    page.tab.keyboard.press("ArrowRight")
    page.shows("frame 2 of 5")
    assert page.picture() != first
    assert page.value("document.getElementById('time').getAttribute('aria-valuetext')") == "10.0 ms, frame 2 of 5"
    page.tab.keyboard.press("End")
    page.shows("frame 5 of 5")


def test_play_and_pause_by_the_keyboard(opened):
    page = opened()
    page.tab.focus("#play")
    page.tab.keyboard.press("Enter")
    assert page.value("document.getElementById('play').textContent") == "Pause"
    page.shows("frame 3 of 5")
    page.tab.keyboard.press("Space")
    assert page.value("document.getElementById('play').getAttribute('aria-pressed')") == "false"
    stopped = page.value("state.time")
    page.tab.wait_for_timeout(200)
    assert page.value("state.time") == stopped


def test_every_channel_and_flow_is_drawn(opened):
    page = opened()
    channels = page.value("[...document.getElementById('channel').options].map(o => o.value)")
    assert channels == ["speed", "vorticity", "pressure", "deviation"]
    pictures = set()
    for channel in channels:
        page.tab.select_option("#channel", channel)
        page.tab.wait_for_timeout(60)
        pictures.add(page.picture())
    assert len(pictures) == 4
    page.tab.select_option("#source", "measurement")
    page.tab.wait_for_timeout(60)
    assert page.value("[...document.getElementById('channel').options].map(o => o.value)") == ["speed", "vorticity"]
    plain = page.picture()
    page.tab.uncheck("#arrows")
    page.tab.wait_for_timeout(60)
    assert page.picture() != plain


def test_the_colours_are_the_flow(opened):
    """The picture's own pixels have the colours of the exact speeds, away from the axis, where those have a cusp."""
    page = opened()
    page.tab.uncheck("#arrows")
    page.tab.wait_for_timeout(60)
    found = page.value(
        """(() => { const view = planeViews[0]; const context = view.canvas.getContext('2d');
        const ratio = view.canvas.width / view.canvas.clientWidth; const out = [];
        const [left, bottom, wide, high] = view.box;
        const { data, width } = context.getImageData(0, 0, view.canvas.width, view.canvas.height);
        for (const [a, b] of [[.3, .3], [.7, .7], [.3, .65]]) {
          const [s, t] = [left + a * wide, bottom + b * high];
          const [x, y] = [Math.round(view.x(s) * ratio), Math.round(view.y(t) * ratio)];
          const pixel = data.slice(4 * (y * width + x));
          const [origin, across, along] = view.plane.axes;
          const place = origin.map((o, k) => o + s * across[k] + t * along[k]);
          out.push({ pixel: [...pixel].slice(0, 3), place });
        } return { out, table: [...colours('viridis')], top: topOf('speed') }; })()"""
    )
    table = np.array(found["table"]).reshape(256, 3)
    for one in found["out"]:
        speed = np.linalg.norm(swirl(np.array([one["place"]]), 0.0))
        number = round(255 * min(1.0, speed / found["top"]))
        nearest = np.abs(table - np.array(one["pixel"])).sum(1).argmin()
        assert abs(int(nearest) - number) <= 3


@pytest.mark.parametrize("width", [1280, 400])
def test_the_keyboard_reaches_everything(opened, width):
    page = opened(width)
    reached = set()
    for _ in range(60):
        page.tab.keyboard.press("Tab")
        name, visible = page.value(
            """(() => { const e = document.activeElement; const style = getComputedStyle(e);
            const label = e.id || (e.className + e.tagName + [...document.querySelectorAll('canvas')].indexOf(e));
            return [label, style.outlineStyle !== 'none' && parseFloat(style.outlineWidth) > 0]; })()"""
        )
        if name.endswith("BODY-1"):
            break
        assert visible, f"{name} has no visible focus"
        reached.add(name)
    assert {"play", "time", "source", "channel", "pace", "arrows", "tracers"} <= reached
    assert sum("CANVAS" in name for name in reached) == 4  # three planes and the view in space
    assert any("SUMMARY" in name for name in reached)
    unnamed = page.value(
        """[...document.querySelectorAll('button, input, select, canvas')].filter(e =>
        !(e.labels && e.labels.length) && !e.textContent && !e.getAttribute('aria-label')).length"""
    )
    assert unnamed == 0


def test_values_are_read_by_keyboard_and_the_view_turns(opened):
    page = opened()
    page.tab.focus("#planes canvas >> nth=0")
    for _ in range(2):
        page.tab.keyboard.press("ArrowLeft")
    assert "towards you" in page.value("document.getElementById('reading-0').textContent")
    before = page.picture(3)
    page.tab.focus("#planes canvas.space")
    page.tab.keyboard.press("ArrowLeft")
    assert page.picture(3) != before


def test_pathlines_move_between_frames(opened):
    page = opened()
    pictures = set()
    for share in (0.0, 0.3, 0.6):
        page.value(f"(state.time = DATA.time[0] + {share} * (DATA.time[1] - DATA.time[0]), drawAll())")
        pictures.add(page.picture(3))
    assert len(pictures) == 3


@pytest.mark.parametrize("width", [1280, 400, 320])
def test_it_fits_the_screen(opened, width):
    page = opened(width, 800)
    assert page.value("document.documentElement.scrollWidth") <= width
    wide = page.value(
        """[...document.querySelectorAll('body *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1
        && !e.closest('.wide') && getComputedStyle(e).position !== 'absolute').map(e => e.tagName)"""
    )
    assert wide == []
    sizes = page.value("[...document.querySelectorAll('#planes canvas')].map(c => [c.clientWidth, c.clientHeight])")
    assert all(w >= 140 and h >= 140 for w, h in sizes)


def test_a_click_in_a_curve_goes_to_its_time(opened):
    page = opened()
    canvas = page.tab.locator("#curves canvas").first
    box = canvas.bounding_box()
    canvas.click(position={"x": box["width"] - 12, "y": 40})
    page.shows("frame 5 of 5")
    assert "(0.5" in page.value("document.querySelector('.legend').textContent")
