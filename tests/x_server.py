"""Programs that open the player's window (`real_window`), run under an X server of their own."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

TESTS = Path(__file__).resolve().parent

needs_x = pytest.mark.skipif(
    any(shutil.which(name) is None for name in ("xvfb-run", "xauth", "xdotool")),
    reason="needs xvfb-run, xauth and xdotool (Debian: xvfb xauth xdotool)",
)

PLAY = """
import json
from pathlib import Path
import numpy as np
from cap4d.app.overlays.overlays import Overlay
from real_window import WatchedWindow, open_player, pump

with WatchedWindow("play", 760, 480) as window:
    player = open_player(window, [NAME], Path())
    viewer, place = player.viewer, player._layout().picture
    pump(player, lambda: player.frames > 0, 60)
    face = np.s_[place.y : place.y + place.height, place.x : place.x + place.width]
    first = window.picture[face].astype(int)
    changed = lambda: int((np.abs(window.picture[face].astype(int) - first) > 16).any(-1).sum())
    pump(player, lambda: changed() > 500, 60)  # px: the idle clip plays
    found = {"rig": viewer.avatar.rig_name, "tier": viewer.avatar.tier}
    frames = player.frames
    viewer.overlays = frozenset(Overlay)
    pump(player, lambda: player.frames > frames + 2, 60)
    found["messages"] = [t.text for t in viewer.toasts.current(viewer.now)]
    player.close()
json.dump(found, open("found.json", "w"))
"""
"""Opens NAME (a text of Python's), sees its face move, and shows all overlays."""


def run(program: str, folder: Path, *, screen: str = "1280x800x24") -> tuple[dict[str, Any], str]:
    """What a program wrote to found.json in `folder`, where it runs, and what it said on stderr."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS / "unit")]),
        "LIBGL_ALWAYS_SOFTWARE": "1",
        "XDG_CONFIG_HOME": str(folder / "config"),
    }
    words = ["xvfb-run", "-a", "-s", f"-screen 0 {screen}", sys.executable, "-c", program]
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=170)
    if "window: expected OpenGL 4.1" in done.stderr:
        pytest.skip("the X server has no OpenGL 4.1")
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "found.json").read_text()), done.stderr
