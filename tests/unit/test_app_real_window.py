"""The window on a real X server, worked by its real pointer and keyboard."""

from __future__ import annotations

import json

import pytest
from tiny_bundle import tiny_bundle, tiny_bundle_on_mesh
from x_server import needs_x, run

from cap4d.bundle import write_bundle

PROGRAM = """
import json, sys
from pathlib import Path
import numpy as np
from real_window import WatchedWindow, drag, open_player, pump, pump_for, xdotool

found = {}
with WatchedWindow("test", 760, 480) as window:
    player = open_player(window, ["tiny.cap4d", "--deformer", "off"], Path())
    viewer = player.viewer
    pump(player, lambda: player.frames > 0)
    xdotool(player, "mousemove", 300, 200, "click", 1)  # X11 gives the keyboard to no window by itself
    xdotool(player, "key", "space")
    found["paused"] = viewer.playback.is_paused
    before, place = window.picture, player._layout().picture
    side = player._layout().sidebar
    bar = side.x + 60, side.y + 151
    drag(player, bar, (bar[0] + 150, bar[1]))
    found["held"] = [viewer.expressions[0].name] * bool(viewer.overrides.held[viewer.expressions[0].index])
    found["value"] = float(viewer.overrides.values[viewer.expressions[0].index])
    face = np.s_[place.y : place.y + place.height, place.x : place.x + place.width]
    found["changed"] = int((np.abs(window.picture[face].astype(int) - before[face]) > 16).any(-1).sum())
    found["orbit before"] = viewer.controls.orbit is not None
    drag(player, (150, 200), (220, 210))
    found["orbit after"] = viewer.controls.orbit is not None
    found["before"] = viewer.controls.orbit.distance
    xdotool(player, "mousemove", 200, 200, "click", 4)
    found["nearer"] = viewer.controls.orbit.distance
    xdotool(player, "key", "s")
    pump(player, lambda: viewer.jobs.label is None)
    xdotool(player, "key", "v")
    viewer.playback.toggle(viewer.now)
    pump_for(player, 0.5)
    player.input.dropped([Path("broken.cap4d"), Path("tiny.cap4d"), Path("nothing.xyz")])
    pump(player, lambda: viewer.jobs.label is None)
    pump_for(player, 0.2)
    xdotool(player, "key", "v")
    pump(player, lambda: viewer.jobs.label is None)
    found["messages"] = [t.text for t in viewer.toasts.current(viewer.now)]
    xdotool(player, "key", "q")
    found["closed"] = window.should_close
    player.close()
json.dump(found, open("found.json", "w"))
"""


@needs_x
def test_a_real_pointer_and_keyboard_work_it(tmp_path):
    write_bundle(tiny_bundle(network=False), tmp_path / "tiny.cap4d")
    (tmp_path / "broken.cap4d").write_bytes((tmp_path / "tiny.cap4d").read_bytes()[:3000])
    found, _ = run(PROGRAM, tmp_path)
    assert found["paused"]
    assert found["held"] == ["browInnerUp"]
    assert 0.4 < found["value"] <= 1
    assert found["changed"] > 500  # px of the face
    assert (found["orbit before"], found["orbit after"]) == (False, True)
    assert found["nearer"] < found["before"]
    assert (tmp_path / "tiny_0001.png").is_file()
    assert (tmp_path / "tiny_0001.mp4").stat().st_size > 1000
    assert any("broken.cap4d" in text for text in found["messages"])
    assert any("nothing.xyz" in text for text in found["messages"])
    assert found["closed"]
    assert json.loads((tmp_path / "config/cap4d/recent.json").read_text()) == [str(tmp_path / "tiny.cap4d")]


SOAK = """
import json
from pathlib import Path
from real_window import WatchedWindow, open_player, pump
from window_soak import soak_round, write_droppings

with WatchedWindow("soak", 760, 480) as window:
    player = open_player(window, ["tiny.cap4d", "--backend", BACKEND], Path())
    pump(player, lambda: player.frames > 0)
    errors = soak_round(player, write_droppings(Path.cwd(), Path("tiny.cap4d")), Path.cwd())
    found = {"errors": sorted(errors), "shape": window.picture.shape, "tier": player.viewer.avatar.tier}
    found["files"] = sorted(p.name for p in Path.cwd().glob("tiny_0*"))
    player.close()
json.dump(found, open("found.json", "w"))
"""


@needs_x
@pytest.mark.parametrize(
    ("backend", "make"),
    [
        ("cpu", tiny_bundle),
        ("cpu", tiny_bundle_on_mesh),
        pytest.param("gl", tiny_bundle, marks=pytest.mark.slow),
    ],
)
def test_panels_sizes_and_drops_while_it_records(tmp_path, backend, make):
    write_bundle(make(), tmp_path / "tiny.cap4d")
    found, said = run(SOAK.replace("BACKEND", repr(backend)), tmp_path, screen="4096x2304x24")
    assert said == ""
    assert found["shape"] == [760, 1180, 3]
    assert found["files"] == ["tiny_0001.mp4", "tiny_0001.png"]
    nothings = ("broken.cap4d", "broken.npz", "missing.wav", "notes.txt")
    assert [sum(name in text for text in found["errors"]) for name in nothings] == [1, 1, 1, 1]
    assert len(found["errors"]) == len(nothings)
