"""The page in a real browser."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("websockets")
pytest.importorskip("onnx")

from chromium import browser, chromium
from served_page import command

needs_chromium = pytest.mark.skipif(
    chromium() is None, reason="no Chromium (Debian: apt-get install chromium)"
)


PIXELS = """(() => {
  const { width, height } = picture;
  return Array.from(picture.getContext("2d").getImageData(0, 0, width, height).data);
})()"""


STANDS = "new Promise((done) => { const n = cap4d.shown; setTimeout(() => done(n === cap4d.shown), 600); })"


@contextlib.contextmanager
def watched(served, profile: Path, *, size: tuple[int, int], shown: int):
    """The page in a browser of that size that has shown so many pictures."""
    with browser(profile) as page:
        page.resize(*size)
        page.goto(f"http://127.0.0.1:{served.port}/")
        page.wait_for(f"window.cap4d && cap4d.shown >= {shown}")
        yield page


def pixels(page) -> np.ndarray:
    width, height = page.evaluate("[picture.width, picture.height]")
    return np.array(page.evaluate(PIXELS)).reshape(height, width, 4)[..., :3]


@needs_chromium
def test_chromium_shows_an_avatar_that_moves_and_its_latency(served, tmp_path):
    with watched(served, tmp_path, size=(320, 240), shown=30) as page:
        first = pixels(page)
        page.wait_for("cap4d.shown >= 34")
        second = pixels(page)
        paper = np.array(
            page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
        )
        assert np.abs(first[0, 0] - paper).max() < 12  # the picture has no edges
        assert (np.abs(first - paper).max(-1) > 40).mean() > 0.05  # somebody is there
        assert np.abs(first - second).max() > 20
        latency, fps = page.evaluate("[cap4d.latency, cap4d.fps]")
        shown = page.wait_for("document.getElementById('figures').textContent")
        assert 0 < latency < 1000
        assert "fps" in shown and "ms" in shown
        print(f"Chromium: {fps:.1f} pictures a second, {latency:.1f} ms to the echo; shows {shown!r}")
        assert page.errors == []


@needs_chromium
def test_in_chromium_hands_turn_pause_and_move_the_face(served, tmp_path):
    with watched(served, tmp_path, size=(640, 480), shown=5) as page:
        page.evaluate("document.getElementById('play').click()")
        page.wait_for("document.body.classList.contains('paused')")
        page.wait_for(STANDS)
        before = pixels(page)
        count = page.evaluate("cap4d.shown")
        page.drag((200, 200), (320, 200))
        page.wait_for(f"cap4d.shown > {count + 1}")
        assert np.abs(pixels(page) - before).max() > 50
        page.evaluate("document.getElementById('faces').click()")
        assert page.evaluate("[...document.querySelectorAll('#sliders label:not([hidden])')].length") == 5
        page.evaluate("search.value = 'BLINK left'; search.dispatchEvent(new Event('input'))")
        assert (
            page.evaluate("document.querySelector('#sliders label:not([hidden])').dataset.name")
            == "eyeBlinkLeft"
        )
        page.evaluate(
            "(() => { const i = document.querySelector('#sliders label:not([hidden]) input');"
            "i.value = 1; i.dispatchEvent(new Event('input')); })()"
        )
        page.wait_for("document.querySelector('#sliders .held output')?.textContent === '1.00'")
        assert served.studio.performance.held == {"eyeBlinkLeft": 1.0}
        page.evaluate("document.getElementById('reset').click()")
        page.evaluate("document.getElementById('play').click()")
        page.wait_for(
            "!document.body.classList.contains('paused') && !document.querySelector('#sliders .held')"
        )
        assert page.errors == []


@needs_chromium
def test_chromium_without_the_token_is_refused_and_with_it_not(tiny, tmp_path):
    with command("--serve", "0.0.0.0:0") as (_, address), browser(tmp_path / "profile") as page:
        port, _, token = address.rpartition(":")[2].partition("/?token=")
        assert len(token) > 20
        here = f"http://127.0.0.1:{port}"
        page.goto(f"{here}/")
        assert "needs the token" in page.evaluate("document.body.innerText")
        answer = page.evaluate(
            f"new Promise((done) => {{ const s = new WebSocket('ws://127.0.0.1:{port}/socket');"
            "s.onopen = () => done('open'); s.onerror = () => done('refused'); })"
        )
        assert answer == "refused"
        page.goto(f"{here}/?token={token}")
        page.wait_for("window.cap4d && cap4d.shown >= 3")


@needs_chromium
def test_chromium_waits_for_a_viewer_that_went_away(tiny, tmp_path):
    with browser(tmp_path / "profile") as page:
        with command("--serve", ":0") as (_, address):
            page.goto(address)
            page.wait_for("window.cap4d && cap4d.shown >= 3")
        page.wait_for("document.getElementById('notice').textContent.includes('is away')")
        with command("--serve", address.split("/")[2]):
            count = page.evaluate("cap4d.shown")
            page.wait_for(f"cap4d.shown > {count} && !document.body.classList.contains('away')")
