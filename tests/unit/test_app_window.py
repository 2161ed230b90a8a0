"""A window on a display, and none where there is no display."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cap4d.app.window import DisplayUnavailableError, Window
from tiny_bundle import tiny_bundle

from cap4d.bundle import write_bundle

HERE = Path(__file__).resolve().parent


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="X11 and Wayland are found through the environment"
)
def test_no_display_is_one_line(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(DisplayUnavailableError, match="expected a display, found none"):
        Window("test", 64, 64)


WINDOW_PROGRAM = """
import sys
import numpy as np
from pathlib import Path
from cap4d.app.live import play_live
from cap4d.app.options import parse_options
from cap4d.app.window import Window

class Watched(Window):
    def swap(self):
        self.last = np.frombuffer(self.ctx.screen.read(components=3), np.uint8)
        super().swap()

options = parse_options(sys.argv[2:])
with Watched("test", *options.size) as window:
    play_live(options.avatar, options, window)
    np.save(sys.argv[1], window.last.reshape(*window.framebuffer_size[::-1], 3)[::-1])
"""


@pytest.mark.parametrize("backend", ["cpu", "gl"])
def test_a_real_window_opens_plays_and_closes(backend, tmp_path):
    if shutil.which("xvfb-run") is None or shutil.which("xauth") is None:
        pytest.skip("needs xvfb-run and xauth")
    write_bundle(tiny_bundle(network=False), tmp_path / "tiny.cap4d")
    arguments = ["tiny.cap4d", "--frames", "12", "--size", "200x160", "--backend", backend]
    program = [sys.executable, "-c", WINDOW_PROGRAM, "last.npy", *arguments]
    environment = os.environ | {
        "PYTHONPATH": str(HERE.parent),
        "LIBGL_ALWAYS_SOFTWARE": "1",
        "XDG_CONFIG_HOME": str(tmp_path),
    }
    run = ["xvfb-run", "-a", *program]
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    if "window: expected OpenGL 4.1" in done.stderr:
        pytest.skip("the X server has no OpenGL 4.1")
    assert done.returncode == 0, done.stderr
    picture = np.load(tmp_path / "last.npy")
    assert picture.shape == (160, 200, 3)
    assert (picture[-10:, -10:] == 255).all()
    assert picture[60:100, 80:120].std() > 3
