"""The state behind the panels: no window, no OpenGL, no threads."""

from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cap4d.app.background import Picture
from cap4d.app.loading import load_avatar, open_playback
from cap4d.app.overrides import HEAD
from cap4d.app.playback import ClipPlayback, StreamPlayback
from cap4d.app.recent import RecentFiles
from cap4d.app.shortcuts import Action
from cap4d.app.toasts import Tone
from cap4d.app.viewer import Viewer
from stepped_clock import SteppedClock
from test_app_playback import Stream
from tiny_bundle import RIG_NAME, tiny_bundle

from cap4d.bundle import write_bundle
from cap4d.drive.clip import Frame
from cap4d.errors import ArgumentError
from cap4d.player.png import encode_png


class AtOnce(Executor):
    """Does the work where it is asked for."""

    def submit(self, work, /, *arguments, **settings):
        future = Future()
        try:
            future.set_result(work(*arguments, **settings))
        except Exception as error:
            future.set_exception(error)
        return future


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder of avatars with and without a network, and what may be dropped beside them."""
    folder = tmp_path_factory.mktemp("files")
    write_bundle(tiny_bundle(), folder / "tiny.cap4d")
    plain = tiny_bundle(network=False)
    write_bundle(plain, folder / "plain.cap4d")
    (folder / "broken.cap4d").write_bytes((folder / "tiny.cap4d").read_bytes()[:2000])
    (folder / "behind.png").write_bytes(encode_png(np.full((40, 30, 3), 90, np.uint8)))
    return folder


@pytest.fixture
def show(files, tmp_path):
    """Makes a viewer."""
    viewers = []

    def make(name="tiny.cap4d", **settings):
        loaded = load_avatar(files / name, settings.get("deformer", "auto"))
        playback = open_playback(None, loaded.bundle)
        recent = RecentFiles(tmp_path / "recent.json")
        clock = SteppedClock()
        viewer = Viewer(loaded, playback, recent=recent, clock=clock, executor=AtOnce(), **settings)
        playback.rewind(clock())
        viewers.append(viewer)
        return viewer

    yield make
    for viewer in viewers:
        viewer.close()


def messages(viewer, tone=None):
    return [t.text for t in viewer.toasts.current(viewer.now) if tone in (None, t.tone)]


def test_it_starts_with_a_quick_deformer_and_settles_on_the_one_that_suits(show):
    viewer = show()
    assert viewer.avatar.tier == "off"
    viewer.settle()
    assert viewer.is_settling
    viewer.poll()
    assert viewer.avatar.tier == "full"
    assert viewer.loaded.is_settled
    assert not viewer.is_settling


def test_a_network_that_does_not_load_is_said_once_and_the_quick_deformer_stays(show, monkeypatch):
    def fails(*_):
        raise ArgumentError("no network")

    monkeypatch.setattr("cap4d.app.viewer.with_deformer", fails)
    viewer = show()
    for _ in range(3):
        viewer.settle()
        viewer.poll()
    assert [t.count for t in viewer.toasts.current(viewer.now)] == [1]
    assert viewer.avatar.tier == "off"
    assert not viewer.is_settling


def test_a_deformer_that_was_asked_for_is_there_at_once(show):
    assert show(deformer="full").loaded.is_settled
    assert show("plain.cap4d").loaded.is_settled  # it has one only
    with pytest.raises(ArgumentError, match="int8"):
        show(deformer="int8")


def test_the_deformer_changes_at_run_time_and_keeps_the_times(show):
    viewer = show()
    viewer.avatar.stages.add("rig", 0.5)
    viewer.act(Action.NEXT_DEFORMER)
    viewer.poll()
    assert viewer.avatar.tier == "full"
    assert viewer.avatar.stages.seconds["rig"][-1] == 0.5
    viewer.act(Action.NEXT_DEFORMER)
    viewer.poll()
    assert viewer.avatar.tier == "off"


def test_a_new_picture_is_due_only_when_something_changed(show):
    viewer = show()
    viewer.act(Action.PLAY)
    seen = viewer.number()
    viewer.clock.now += 10
    assert viewer.number() == seen
    changes = (
        lambda: viewer.overrides.hold(0, 0.5),
        lambda: viewer.controls.scroll(1),
        lambda: setattr(viewer, "background", (0.0, 0.0, 0.0)),
        lambda: setattr(viewer, "overlays", frozenset({"mesh"})),
        lambda: viewer.act(Action.NEXT),
        lambda: (viewer.act(Action.NEXT_DEFORMER), viewer.poll()),
    )
    for change in changes:
        change()
        assert viewer.number() != seen
        seen = viewer.number()


def test_what_is_held_is_part_of_the_frame(show):
    viewer = show()
    viewer.overrides.hold(2, 0.75)
    viewer.number()
    assert viewer.frame().expr[2] == 0.75
    viewer.act(Action.RESET_FACE)
    assert viewer.frame().expr[2] != 0.75
    viewer.act(Action.NEUTRAL_FACE)
    assert not viewer.frame().expr.any()
    viewer.act(Action.RANDOM_FACE)
    assert viewer.frame().expr.any()


def test_a_dropped_avatar_takes_the_place_of_the_one_shown(show, files):
    viewer = show("plain.cap4d", is_welcome=True)
    viewer.overrides.hold(0, 1.0)
    viewer.controls.scroll(1)
    before = viewer.playback
    viewer.open(files / "tiny.cap4d")
    assert viewer.poll()
    assert viewer.loaded.path == files / "tiny.cap4d"
    assert viewer.playback is not before
    assert viewer.overrides.count == 0
    assert viewer.controls.orbit is None
    assert not viewer.is_welcome
    assert viewer.recent.files == [files / "tiny.cap4d"]
    assert "tiny.cap4d" in messages(viewer)[0]


def test_an_avatar_without_the_deformer_of_the_last_one_is_shown_all_the_same(show, files):
    viewer = show(deformer="full")
    viewer.open(files / "plain.cap4d")
    viewer.poll()
    assert (viewer.loaded.path.name, viewer.avatar.tier) == ("plain.cap4d", "off")


@pytest.mark.parametrize(
    "name", ["broken.cap4d", "missing.cap4d", "missing.npz", "missing.wav", "what.xyz", "no.png"]
)
def test_a_file_that_is_nothing_is_a_message_and_nothing_changes(show, files, name):
    viewer = show()
    loaded, playback = viewer.loaded, viewer.playback
    viewer.open(files / name)
    viewer.poll()
    assert len(messages(viewer, Tone.ERROR)) == 1
    assert name in messages(viewer)[0]
    assert (viewer.loaded, viewer.playback) == (loaded, playback)
    assert viewer.recent.files == []


def test_a_recent_file_that_is_gone_is_said_and_forgotten(show, files, tmp_path):
    viewer = show()
    gone, there = tmp_path / "gone.npz", files / "plain.cap4d"
    viewer.recent.add(gone)
    viewer.recent.add(there)
    viewer.open(gone)
    viewer.poll()
    assert "gone.npz" in messages(viewer, Tone.ERROR)[0]
    assert viewer.recent.files == [there]
    viewer.open(there)
    assert viewer.recent.files == [there]


def test_a_dropped_image_stands_behind(show, files):
    viewer = show()
    viewer.open(files / "behind.png")
    viewer.poll()
    assert isinstance(viewer.background, Picture)


def test_a_live_source_takes_the_clips_place_and_gives_it_back(show, monkeypatch):
    viewer = show()
    stream = Stream(Frame(0.0, RIG_NAME, *(np.zeros(n, np.float32) for n in (5, 3, 3, 3))))
    live = StreamPlayback(stream, rig_name=RIG_NAME)
    monkeypatch.setattr("cap4d.app.viewer.open_playback", lambda spec, _, **_settings: live if spec else clip)
    clip = ClipPlayback(viewer.avatar.idle, 0.0)
    viewer.drive("tcp://127.0.0.1:9000")
    viewer.poll()
    assert viewer.playback is live
    assert viewer.recent.files == []
    viewer.act(Action.PLAY)  # a stream cannot be paused
    stream.error = ArgumentError("the port is taken")
    viewer.poll()
    viewer.poll()
    assert messages(viewer, Tone.ERROR) == ["the port is taken"]
    assert viewer.playback is clip
    assert not stream.runs


def test_a_real_live_source_over_a_socket(show):
    import socket
    import time

    viewer = show()
    viewer.clock = time.monotonic
    viewer.drive("tcp://127.0.0.1:0")
    viewer.poll()
    host, port = viewer.playback.name.removeprefix("tcp://").split(":")
    first = viewer.number()
    with socket.create_connection((host, int(port))) as sender:
        end = time.monotonic() + 10
        for i in range(1000):
            line = f'{{"t": {i / 50}, "rig": "{RIG_NAME}", "expr": [0.5, 0, 0, 0, 0]}}\n'
            sender.sendall(line.encode())
            time.sleep(0.02)
            viewer.number()
            if viewer.playback.state == "playing" and viewer.frame().expr[0] == pytest.approx(0.5):
                break
            assert time.monotonic() < end
    assert viewer.number() != first
    assert viewer.playback.statistics()["received"] > 0


def test_another_rigs_clip_is_refused(show, files, monkeypatch):
    viewer = show()
    foreign = ClipPlayback(replace(viewer.avatar.idle, rig_name="other"), 0.0)
    monkeypatch.setattr("cap4d.app.viewer.open_playback", lambda *_, **_settings: foreign)
    playback = viewer.playback
    viewer.drive("other.npz")
    viewer.poll()
    assert viewer.playback is playback
    assert "expected expressions of tiny" in messages(viewer)[0]


def test_a_source_asked_for_while_an_avatar_loads_is_opened_for_that_avatar(show, files, monkeypatch):
    viewer = show("plain.cap4d")
    opened = []

    def open_for(spec, bundle, **settings):
        opened.append((spec, bundle))
        return open_playback(None, bundle)

    monkeypatch.setattr("cap4d.app.viewer.open_playback", open_for)
    viewer.open(files / "tiny.cap4d")
    viewer.drive("talk.npz")
    viewer.poll()
    assert viewer.loaded.path == files / "tiny.cap4d"
    assert opened[-1] == ("talk.npz", viewer.loaded.bundle)


def test_a_live_source_of_another_rig_is_closed(show, monkeypatch):
    viewer = show()
    zeros = np.zeros(3, np.float32)
    stream = Stream(Frame(0.0, "other", np.zeros(5, np.float32), zeros, zeros, zeros))
    foreign = StreamPlayback(stream, rig_name="other")
    monkeypatch.setattr("cap4d.app.viewer.open_playback", lambda *_, **_settings: foreign)
    viewer.drive("tcp://127.0.0.1:9000")
    viewer.poll()
    assert "expected expressions of tiny" in messages(viewer, Tone.ERROR)[0]
    assert not stream.runs


def test_a_live_head_turns_in_the_picture_but_does_not_leave_it(show):
    viewer = show()
    zeros = np.zeros(3, np.float32)
    frame = Frame(0.0, RIG_NAME, np.zeros(5, np.float32), zeros, zeros, zeros)
    still = viewer.camera(frame, (64, 64))
    turned = replace(frame, rot=np.float32([0, 0.4, 0]), tra=np.float32([0, 0, -0.6]))
    np.testing.assert_array_equal(
        viewer.camera(turned, (64, 64)).viewmat, still.viewmat
    )  # a clip's is left out
    viewer.playback = StreamPlayback(Stream(frame), rig_name=RIG_NAME)
    camera = viewer.camera(turned, (64, 64))
    np.testing.assert_allclose(camera.viewmat[:3, 3], still.viewmat[:3, 3], atol=1e-9)
    assert np.abs(camera.viewmat - still.viewmat).max() > 0.1


def test_the_hand_turns_the_head_under_the_users_own_camera_too(show):
    viewer = show()
    viewer.controls.scroll(1)
    viewer.number()
    before = viewer.camera(viewer.frame(), (64, 64)).viewmat
    viewer.overrides.hold_turn(HEAD, np.array([0, 0.3, 0]))
    assert np.abs(viewer.camera(viewer.frame(), (64, 64)).viewmat - before).max() > 0.1


def test_keys_steer_the_clip(show):
    viewer = show()
    playback = viewer.playback
    viewer.number()
    viewer.act(Action.NEXT)
    assert playback.is_paused
    assert playback.position == pytest.approx(1 / 24)
    viewer.act(Action.REWIND)
    assert playback.position == 0
    viewer.act(Action.FASTER)
    assert playback.speed == 1.5
    viewer.act(Action.SLOWER)
    viewer.act(Action.SLOWER)
    assert playback.speed == 0.5
    viewer.act(Action.LOOP)
    assert not playback.loops
    viewer.act(Action.SMOOTH)
    assert playback.is_smooth
    viewer.act(Action.SMOOTH)
    assert not playback.is_smooth


def test_what_only_the_window_can_do_is_left_to_it(show):
    viewer = show()
    for action in (Action.SCREENSHOT, Action.RECORD, Action.FULLSCREEN, Action.CLOSE):
        viewer.act(action)
    assert list(viewer.asked) == [Action.SCREENSHOT, Action.RECORD, Action.FULLSCREEN, Action.QUIT]
    viewer.act(Action.OPEN)
    viewer.act(Action.CLOSE)
    assert viewer.dialog is None
    assert len(viewer.asked) == 4


def test_the_dropped_file_may_be_a_string_of_anything(show):
    viewer = show()
    for name in ("", ".", "a\x00b.cap4d", "x" * 5000 + ".npz", "\udcff.wav"):
        viewer.open(Path(name))
        viewer.poll()
    assert len(messages(viewer, Tone.ERROR)) == 4  # the oldest gave way


def test_a_source_chosen_later_is_opened_as_the_command_line_said(show, monkeypatch):
    sender, fill, asked = Path("flame.npz"), {"blink": False}, []
    viewer = show(sender=sender, fill=fill)
    clip = ClipPlayback(viewer.avatar.idle, 0.0)
    opened = lambda *_, **settings: asked.append(settings) or clip  # noqa: E731
    monkeypatch.setattr("cap4d.app.viewer.open_playback", opened)
    viewer.drive("tcp://127.0.0.1:9000")
    assert asked == [{"sender": sender, "fill": fill}]
