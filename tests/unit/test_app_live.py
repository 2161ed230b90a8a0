"""The playing window: its loop on a framebuffer of our own, its input, and the real thing under Xvfb."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import glfw
import numpy as np
import pytest
from cap4d.app.controls import Controls, Drag
from cap4d.app.gl_context import GlUnavailableError, headless_context
from cap4d.app.live import LivePlayer, ReadOut, choose_renderer
from cap4d.app.play_clock import PlayClock
from cap4d.app.renderers import CpuRenderer, GlRenderer
from cap4d.app.window import DisplayUnavailableError, Window, _key, _press
from tiny_bundle import tiny_bundle

from cap4d.bundle import write_bundle
from cap4d.player.avatar import Avatar
from cap4d.player.camera_path import camera_path
from cap4d.player.offline import head_centre

HERE = Path(__file__).resolve().parent


class Pane:
    """A window without a display: what LivePlayer wants of one, with `scale` pixels per unit."""

    def __init__(self, ctx, size, scale=1):
        self.ctx, self.size, self.should_close = ctx, size, False
        self.framebuffer_size = (size[0] * scale, size[1] * scale)
        self.pictures = []

    def use(self):
        width, height = self.framebuffer_size
        self.target = self.ctx.simple_framebuffer((max(width, 1), max(height, 1)))
        self.target.use()
        return self.framebuffer_size

    def swap(self):
        flat = np.frombuffer(self.target.read(components=3), np.uint8)
        self.pictures.append(flat.reshape(*self.target.size[::-1], 3)[::-1])

    def poll(self):
        pass

    def wait(self, seconds):
        self.waited = seconds

    def connect(self, controls):
        self.controls = controls


@pytest.fixture(scope="module")
def ctx():
    try:
        context = headless_context()
    except GlUnavailableError as error:
        pytest.skip(str(error))
    yield context
    context.gc()
    context.release()


@pytest.fixture(scope="module")
def avatar():
    return Avatar(tiny_bundle(network=False))


@pytest.fixture
def play(ctx, avatar):
    """Makes a player in a pane."""
    players = []

    def make(renderer=CpuRenderer, size=(120, 90), scale=1):
        pane = Pane(ctx, size, scale)
        cameras = camera_path("static", avatar.camera, head_centre(avatar), fps=24, size=None)
        players.append(LivePlayer(pane, renderer(ctx, avatar), avatar, avatar.idle, cameras))
        return players[-1], pane

    yield make
    for player in players:
        player.hud.release()


@pytest.mark.parametrize("renderer", [CpuRenderer, GlRenderer])
def test_the_picture_is_upright_and_whole(play, avatar, renderer):
    player, pane = play(renderer)
    player.controls.shows_hud = False
    player.run(1)
    camera = player._camera(0, avatar.idle.frame(0))
    expected = avatar.draw(avatar.idle.frame(player.clock.index(0)), camera, background=(1, 1, 1))
    assert np.abs(pane.pictures[0].astype(int) - expected[..., :3]).max() <= 2


def test_it_shows_the_number_of_pictures_asked_for_and_counts_them(play):
    player, pane = play()
    player.run(5)
    stats = player.statistics()
    assert len(pane.pictures) == stats["frames"] == 5
    assert stats["backend"] == "cpu"
    assert {"rig", "bind", "splat", "frame"} <= set(stats["stages"])


def test_a_paused_window_draws_nothing_until_something_changes(play):
    player, pane = play()
    player.run(1)
    player.controls.key("space", 0.0)
    shown = [player._show() for _ in range(3)]
    assert shown[1:] == [False, False]
    player.controls.scroll(1)
    assert player._show()
    assert (pane.pictures[-1] != pane.pictures[0]).any()


def test_the_read_out_is_in_the_corner_and_can_be_hidden(play):
    player, pane = play(size=(320, 200))
    player.run(3)
    player.controls.key("space", 0.0)
    player.controls.scroll(1)
    player._show()
    player.controls.key("h", 0.0)
    player._show()
    changed = (pane.pictures[-2] != pane.pictures[-1]).any(-1)
    assert changed[10:60, 10:80].mean() > 0.05
    assert not changed[:, 200:].any()


def test_a_display_of_two_pixels_a_unit_gets_a_picture_of_its_pixels(play):
    player, pane = play(GlRenderer, scale=2)
    player.run(3)
    assert pane.pictures[0].shape == (180, 240, 3)
    assert player.renderer.splats.picture.size == (240, 180)
    text = (pane.pictures[2] < 60).all(-1)  # of the read-out, which starts 20, 18 units from the corner
    assert text[36:66, 40:110].any()
    assert not text[:34, :38].any()


def test_the_cpu_draws_window_units(play):
    player, pane = play(CpuRenderer, scale=2)
    player.run(1)
    assert player.renderer.picture.size == (120, 90)
    assert pane.pictures[0].shape == (180, 240, 3)


def test_windows_of_one_pixel_and_none(play):
    player, pane = play(size=(1, 1))
    player.run(1)
    assert pane.pictures[0].shape == (1, 1, 3)
    pane.size = pane.framebuffer_size = (0, 0)
    assert not player._show()


def test_taking_the_camera_starts_from_what_is_seen(play, avatar):
    player, _ = play(size=(64, 64))
    before = player._camera(0, avatar.idle.frame(0))
    player.controls.scroll(0)
    after = player._camera(0, avatar.idle.frame(0))
    np.testing.assert_allclose(after.viewmat, before.viewmat, atol=1e-6)
    np.testing.assert_allclose(after.K, before.K, rtol=1e-6)


def test_auto_leaves_a_software_driver_to_the_cpu(ctx, avatar, monkeypatch):
    pane = Pane(ctx, (10, 10))
    for software, kind in ((True, CpuRenderer), (False, GlRenderer)):
        monkeypatch.setattr("cap4d.app.live.is_software", lambda _, answer=software: answer)
        assert isinstance(choose_renderer("auto", pane, avatar), kind)
        assert isinstance(choose_renderer("gl", pane, avatar), GlRenderer)
        assert isinstance(choose_renderer("cpu", pane, avatar), CpuRenderer)


def test_the_read_out_counts_pictures_per_second():
    read_out = ReadOut()
    assert read_out.fps() == 0
    for i in range(50):
        read_out.tick(100 + i / 20)
    assert read_out.fps() == pytest.approx(20)


def test_buttons_and_keys_reach_the_controls():
    controls = Controls(PlayClock(25, 0.0), lambda: None)
    _press(controls, glfw.MOUSE_BUTTON_LEFT, glfw.PRESS, 0)
    assert controls._drag is Drag.TURN
    _press(controls, glfw.MOUSE_BUTTON_LEFT, glfw.RELEASE, 0)
    assert controls._drag is None
    _press(controls, glfw.MOUSE_BUTTON_LEFT, glfw.PRESS, glfw.MOD_SHIFT)
    assert controls._drag is Drag.PAN
    _press(controls, glfw.MOUSE_BUTTON_RIGHT, glfw.PRESS, 0)
    assert controls._drag is Drag.PAN
    _key(controls, glfw.KEY_SPACE, 0, glfw.PRESS, 0)
    assert controls.clock.paused
    _key(controls, glfw.KEY_Q, 0, glfw.RELEASE, 0)
    assert not controls.quit
    _key(controls, glfw.KEY_Q, 0, glfw.PRESS, 0)
    assert controls.quit


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
    environment = os.environ | {"PYTHONPATH": str(HERE.parent), "LIBGL_ALWAYS_SOFTWARE": "1"}
    run = ["xvfb-run", "-a", *program]
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    if "window: expected OpenGL 4.1" in done.stderr:
        pytest.skip("the X server has no OpenGL 4.1")
    assert done.returncode == 0, done.stderr
    picture = np.load(tmp_path / "last.npy")
    assert picture.shape == (160, 200, 3)
    assert (picture[-10:, -10:] == 255).all()
    assert picture[60:100, 80:120].std() > 3
