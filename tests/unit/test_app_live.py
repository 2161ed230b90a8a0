"""The playing window: its loop on a framebuffer of our own, and its input."""

import json
from dataclasses import replace

import glfw
import numpy as np
import pytest
from cap4d.app.controls import Drag
from cap4d.app.gui import Gui
from cap4d.app.layout import Rect
from cap4d.app.live import LivePlayer, choose_renderer, play_live
from cap4d.app.loading import Loaded
from cap4d.app.options import parse_options
from cap4d.app.panels.notes import WELCOME
from cap4d.app.playback import ClipPlayback
from cap4d.app.recent import RecentFiles
from cap4d.app.renderers import CpuRenderer, GlRenderer
from cap4d.app.shortcuts import Action
from cap4d.app.taking import Taking
from cap4d.app.viewer import Viewer
from imgui_bundle import imgui
from stepped_clock import SteppedClock
from tiny_bundle import tiny_bundle

from cap4d.bundle import write_bundle
from cap4d.errors import ArgumentError
from cap4d.player.avatar import Avatar
from cap4d.player.offline import head_centre

PANELS = 720, 420  # a window that is large enough for all of them


class Pane:
    """A window without a display: what LivePlayer wants of one, with `density` pixels per unit."""

    scale, refresh_rate = 1.0, 60.0

    def __init__(self, ctx, size, density=1):
        self.ctx, self.should_close = ctx, False
        self.pictures, self.title, self.clipboard = [], "", ""
        self.resize(size, density)

    def resize(self, size, density=1):
        self.size, self.framebuffer_size = size, (size[0] * density, size[1] * density)

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

    def connect(self, listener):
        self.listener = listener

    def show_cursor(self, shape):
        self.cursor = shape

    def set_vsync(self, on):
        self.vsync = on

    def set_title(self, title):
        self.title = title

    def close(self):
        self.should_close = True

    def copied(self):
        return self.clipboard

    def copy(self, text):
        self.clipboard = text


@pytest.fixture(scope="module")
def avatar():
    return Avatar(tiny_bundle(network=False))


@pytest.fixture
def play(ctx, avatar, tmp_path):
    """Makes a player in a pane. Time stands still unless a test moves it."""
    players = []

    def make(backend="cpu", size=(120, 90), density=1, **settings):
        pane, clock = Pane(ctx, size, density), SteppedClock()
        loaded = Loaded(tmp_path / "tiny.cap4d", avatar, head_centre(avatar))
        playback = ClipPlayback(avatar.idle, clock())
        recent = RecentFiles(tmp_path / "recent.json")
        viewer = Viewer(loaded, playback, recent=recent, clock=clock, **settings)
        player = LivePlayer(pane, viewer, backend)
        player.clock = clock
        players.append(player)
        return player, pane

    yield make
    for player in players:
        player.close()


def settle(player, steps=12):
    """Steps until nothing changes any more; the number of pictures that took."""
    for done in range(steps):
        if not player.step():
            return done
    raise AssertionError("it never stands still")


def click(player, x, y, button=glfw.MOUSE_BUTTON_LEFT):
    player.input.pointer(x, y)
    settle(player)
    player.input.button(button, True, 0)
    settle(player)
    player.input.button(button, False, 0)
    settle(player)


@pytest.mark.parametrize("backend", ["cpu", "gl"])
def test_the_picture_is_upright_and_whole(play, avatar, backend):
    player, pane = play(backend)
    player.run(1)
    frame = avatar.idle.frame(0)
    expected = avatar.draw(frame, player.viewer.camera(frame, pane.size), background=(1, 1, 1))
    assert np.abs(pane.pictures[0].astype(int) - expected[..., :3]).max() <= 2


@pytest.mark.parametrize("backend", ["cpu", "gl"])
@pytest.mark.parametrize("density", [1, 2])
def test_with_panels_the_picture_keeps_to_its_place(play, avatar, backend, density):
    player, pane = play(backend, size=PANELS, density=density)
    player.run(1)
    place = player._layout().picture
    frame = avatar.idle.frame(0)
    size = (place.width * density, place.height * density) if backend == "gl" else (place.width, place.height)
    assert player.picture.size == size
    picture = pane.pictures[0][::density, ::density]
    expected = avatar.draw(
        frame, player.viewer.camera(frame, (place.width, place.height)), background=(1, 1, 1)
    )
    shown = picture[place.y : place.y + place.height, place.x : place.x + place.width]
    assert np.abs(shown.astype(int) - expected[..., :3]).mean() < (1 if density == 1 else 4)
    outside = picture.copy()
    outside[place.y : place.y + place.height, place.x : place.x + place.width] = 0
    assert (outside.max(-1) < 80).mean() > 0.9  # the panels are dark
    assert (outside.max(-1) > 150).any()  # and there is writing on them


def test_it_shows_the_number_of_pictures_asked_for_and_counts_them(play):
    player, pane = play()
    pane.wait = lambda seconds: setattr(player.clock, "now", player.clock() + max(seconds, 0.001))
    player.run(5)
    stats = player.statistics()
    assert stats["frames"] == 5
    assert stats["backend"] == "cpu"
    assert {"rig", "bind", "splat", "frame", "gui"} <= set(stats["stages"])
    assert stats["dropped"] == 0


def test_a_paused_window_draws_nothing_until_something_changes(play):
    player, pane = play()
    player.run(1)
    player.viewer.act(Action.PLAY)
    settle(player)
    shown = len(pane.pictures)
    player.clock.now += 10
    assert not player.step()
    assert player._pause() > 0.1
    player.viewer.controls.scroll(1)
    assert player.step()
    assert (pane.pictures[-1] != pane.pictures[shown - 1]).any()


def test_moving_over_panels_draws_panels_and_not_the_face_again(play):
    player, _ = play(size=PANELS)
    settle(player)
    drawn = len(player.viewer.avatar.stages.seconds["frame"])
    player.input.pointer(PANELS[0] - 40, 100)
    assert player.step()
    assert len(player.viewer.avatar.stages.seconds["frame"]) == drawn


def test_the_panels_can_be_hidden_and_the_face_gets_their_room(play):
    player, _ = play(size=PANELS)
    settle(player)
    player.viewer.act(Action.PANELS)
    player.step()
    assert player._layout().picture == Rect(0, 0, *PANELS)
    assert player.picture.size == PANELS


def test_windows_of_one_pixel_none_and_many(play):
    player, pane = play(size=PANELS)
    player.run(1)
    for size in ((1, 1), (0, 0), (3840, 2160), (2, 900), PANELS):
        pane.resize(size)
        player.input.damaged()
        assert player.step() == (min(size) > 0)
    assert pane.pictures[-1].shape == (*PANELS[::-1], 3)


def test_taking_the_camera_starts_from_what_is_seen(play, avatar):
    player, _ = play(size=(64, 64))
    frame = avatar.idle.frame(0)
    before = player.viewer.camera(frame, (64, 64))
    player.viewer.controls.scroll(0)
    after = player.viewer.camera(frame, (64, 64))
    np.testing.assert_allclose(after.viewmat, before.viewmat, atol=1e-6)
    np.testing.assert_allclose(after.K, before.K, rtol=1e-6)


def test_auto_leaves_a_software_driver_to_the_cpu(ctx, avatar, monkeypatch):
    for software, kind in ((True, CpuRenderer), (False, GlRenderer)):
        monkeypatch.setattr("cap4d.app.live.is_software", lambda _, answer=software: answer)
        assert isinstance(choose_renderer("auto", ctx, avatar), kind)
        assert isinstance(choose_renderer("gl", ctx, avatar), GlRenderer)
        assert isinstance(choose_renderer("cpu", ctx, avatar), CpuRenderer)


def test_a_drag_over_the_face_turns_it_and_one_over_a_panel_does_not(play):
    player, _ = play(size=PANELS)
    settle(player)
    listener, controls = player.input, player.viewer.controls
    for x, turns in ((650, False), (150, True)):
        listener.pointer(x, 200)
        settle(player)
        listener.button(glfw.MOUSE_BUTTON_LEFT, True, 0)
        settle(player)
        listener.pointer(x - 20, 210)
        settle(player)
        listener.button(glfw.MOUSE_BUTTON_LEFT, False, 0)
        assert (controls.orbit is not None) == turns


def test_a_drag_that_began_on_the_face_goes_on_over_the_panels(play):
    player, _ = play(size=PANELS)
    settle(player)
    listener, controls = player.input, player.viewer.controls
    listener.pointer(300, 200)
    listener.button(glfw.MOUSE_BUTTON_RIGHT, True, 0)
    assert controls._drag is Drag.PAN
    settle(player)
    listener.pointer(600, 200)
    before = controls.orbit
    settle(player)
    listener.pointer(610, 200)
    assert controls.orbit != before
    listener.button(glfw.MOUSE_BUTTON_LEFT, False, 0)  # not the one that drags
    assert controls._drag is Drag.PAN
    listener.button(glfw.MOUSE_BUTTON_RIGHT, False, 0)
    assert controls._drag is None


def test_the_wheel_zooms_over_the_face_and_scrolls_over_a_panel(play):
    player, _ = play(size=PANELS)
    settle(player)
    listener, controls = player.input, player.viewer.controls
    listener.pointer(650, 300)
    settle(player)
    listener.wheel(0, -3)
    assert controls.orbit is None
    listener.pointer(150, 200)
    settle(player)
    listener.wheel(0, 0.25)
    distance = controls.orbit.distance
    listener.key(glfw.KEY_LEFT_SHIFT, glfw.PRESS, 0)
    listener.wheel(1, 0)
    assert controls.orbit.distance == distance
    listener.key(glfw.KEY_LEFT_SHIFT, glfw.RELEASE, glfw.MOD_SHIFT)
    listener.wheel(0, 1)
    assert controls.orbit.distance < distance


def test_keys_reach_the_player_but_not_while_a_word_is_typed(play):
    player, _ = play(size=PANELS)
    settle(player)
    listener, playback = player.input, player.viewer.playback
    listener.key(glfw.KEY_SPACE, glfw.PRESS, 0)
    assert playback.is_paused
    listener.key(glfw.KEY_SPACE, glfw.RELEASE, 0)
    search = player._layout().sidebar
    click(player, search.x + 100, search.y + 90)  # the search field
    assert player.gui.wants_keys
    for letter in "jaw":
        listener.key(getattr(glfw, f"KEY_{letter.upper()}"), glfw.PRESS, 0)
        listener.text(ord(letter))
        listener.key(getattr(glfw, f"KEY_{letter.upper()}"), glfw.RELEASE, 0)
        settle(player, 40)
    assert player.screen.sidebar.panels[0].words == "jaw"
    assert playback.is_paused


def test_a_dragged_bar_takes_its_expression_over_and_changes_the_face(play):
    player, pane = play(size=PANELS)
    player.viewer.act(Action.PLAY)
    settle(player)
    before = pane.pictures[-1]
    side, overrides = player._layout().sidebar, player.viewer.overrides
    x, y = side.x + 60, side.y + 151  # the first bar
    player.input.pointer(x, y)
    settle(player)
    player.input.button(glfw.MOUSE_BUTTON_LEFT, True, 0)
    settle(player)
    player.input.pointer(x + 120, y)
    settle(player)
    player.input.button(glfw.MOUSE_BUTTON_LEFT, False, 0)
    settle(player)
    (index,) = np.flatnonzero(overrides.held)
    assert index == player.viewer.expressions[0].index
    assert 0.4 < overrides.values[index] < 0.9
    face = np.s_[60:300, 40:340]
    assert np.abs(pane.pictures[-1][face].astype(int) - before[face]).max() > 20
    click(player, x, y, glfw.MOUSE_BUTTON_RIGHT)
    assert not overrides.held.any()
    np.testing.assert_array_equal(pane.pictures[-1][face], before[face])


def test_escape_closes_what_is_open_and_then_the_window(play):
    player, pane = play(size=PANELS)
    player.input.key(glfw.KEY_F1, glfw.PRESS, 0)
    settle(player)
    assert player.viewer.shows_help
    player.input.key(glfw.KEY_ESCAPE, glfw.PRESS, 0)
    settle(player)
    assert not player.viewer.shows_help
    assert not pane.should_close
    player.input.key(glfw.KEY_ESCAPE, glfw.PRESS, 0)
    player.step()
    assert pane.should_close


def test_every_tab_menu_and_dialog_draws(play, monkeypatch):
    player, _ = play(size=PANELS, is_welcome=True)
    failures = []
    monkeypatch.setattr("cap4d.app.live.log.warning", lambda *a, **k: failures.append(a))
    for panel in player.screen.sidebar.panels:
        player.screen.sidebar.wanted = panel.title
        player.gui.touch()
        assert settle(player) > 0
    for x in (30, 68, 110):
        click(player, x, 14)
        click(player, 200, 350)
    for action in (Action.HELP, Action.OPEN, Action.CLOSE, Action.DRIVE, Action.CLOSE):
        player.viewer.act(action)
        player.viewer.say("a message")
        player.gui.touch()
        assert player.step()
    assert failures == []
    assert "F1" in WELCOME


def test_vsync_is_a_switch_of_the_view_menu(play, monkeypatch):
    player, pane = play(size=PANELS)
    settle(player)
    assert player.viewer.has_vsync
    items, drawn = {}, imgui.menu_item_simple

    def pressed(text, key="", on=False):
        items[text] = on
        drawn(text, key, on)
        return text == "Vsync"

    click(player, 68, 14)
    monkeypatch.setattr(imgui, "menu_item_simple", pressed)
    player.gui.touch()
    player.step()
    assert items["Vsync"]
    player.step()
    assert not pane.vsync
    player.step()
    assert pane.vsync


def test_a_failing_source_costs_its_pictures_and_is_said(play):
    player, _ = play()
    player.run(1)
    playback = player.viewer.playback
    playback.clip = replace(playback.clip, expr=np.full_like(playback.clip.expr, np.nan))
    for _ in range(3):
        player.clock.now += 1 / 24
        player.step()
    (toast,) = player.viewer.toasts.current(player.clock())
    assert toast.count == 3
    assert player.gui.is_moving  # so that the message is drawn though the face is not
    assert "finite" in toast.text


def test_a_recording_that_fails_at_the_end_keeps_nothing_else_from_ending(ctx, tmp_path, monkeypatch):
    def fails(_):
        raise ArgumentError("no space left")

    ended = []
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setattr(Taking, "close", fails)
    for kind, name in ((Viewer, "close"), (Gui, "release")):
        end = getattr(kind, name)
        monkeypatch.setattr(kind, name, lambda self, end=end: (ended.append(type(self)), end(self)))
    write_bundle(tiny_bundle(network=False), tmp_path / "tiny.cap4d")
    options = parse_options([str(tmp_path / "tiny.cap4d"), "--backend=cpu", f"--stats={tmp_path / 's.json'}"])
    with pytest.raises(ArgumentError, match="no space left"):
        play_live(options.avatar, replace(options, frames=1), Pane(ctx, (120, 90)))
    assert ended == [Viewer, Gui]
    assert (tmp_path / "s.json").is_file()


def test_a_failing_panel_costs_its_panels_only(play, monkeypatch, caplog):
    player, pane = play(size=PANELS)
    settle(player)

    def fails(*_):
        raise RuntimeError("no panel")

    panel = player.screen.sidebar.panels[0]
    monkeypatch.setattr(panel, "draw", fails)
    player.gui.touch()
    assert player.step()
    assert "no panel" in caplog.text
    monkeypatch.undo()
    player.gui.touch()
    settle(player)
    assert (pane.pictures[-1][200:, 400:].max(-1) > 150).any()


def test_ctrl_c_keeps_what_was_measured(tmp_path, monkeypatch):
    class Interrupted:
        def __init__(self, *_):
            pass

        def run(self, frames):
            raise KeyboardInterrupt

        def close(self):
            pass

        def statistics(self):
            return {"frames": 3}

    monkeypatch.setattr("cap4d.app.live.open_viewer", lambda *_: None)
    monkeypatch.setattr("cap4d.app.live.LivePlayer", Interrupted)
    stats = tmp_path / "stats.json"
    with pytest.raises(KeyboardInterrupt):
        play_live(tmp_path / "a.cap4d", parse_options(["--stats", str(stats)]), None)
    assert json.loads(stats.read_text()) == {"frames": 3}
