"""The command line of cap4d-view."""

from pathlib import Path

import pytest
from cap4d.app.options import parse_options


def test_nothing_asked_for_is_a_window_on_the_demo():
    options = parse_options([])
    assert options.avatar is None
    assert options.size is None
    assert (options.backend, options.deformer, options.camera) == ("auto", "auto", "static")
    assert not options.headless


def test_everything_asked_for_arrives():
    line = "me.cap4d --drive a.npy --template n.obj --fps 25 --backend gl --deformer off --size 640x360 "
    line += "--headless --frames 9 --out f_%04d.png --camera orbit --stats s.json"
    options = parse_options(line.split())
    assert options.avatar == Path("me.cap4d")
    assert (options.drive, options.template, options.fps) == ("a.npy", Path("n.obj"), 25.0)
    assert (options.backend, options.deformer, options.size) == ("gl", "off", (640, 360))
    assert (options.headless, options.frames, options.out) == (True, 9, "f_%04d.png")
    assert (options.camera, options.stats) == ("orbit", Path("s.json"))


@pytest.mark.parametrize(
    "line",
    [
        "--size 512",
        "--size 0x512",
        "--size 9000x1",
        "--frames 0",
        "--frames -3",
        "--frames 1.5",
        "--fps 0",
        "--fps nan",
        "--fps fast",
        "--backend vulkan",
        "--deformer some",
        "a.cap4d b.cap4d",
        "--unknown",
    ],
)
def test_a_bad_argument_is_refused_in_one_line_with_code_2(line, capsys):
    with pytest.raises(SystemExit) as stop:
        parse_options(line.split())
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("cap4d-view: error:") and said.count("\n") == 1


def test_help_has_examples_and_keys(capsys):
    with pytest.raises(SystemExit) as stop:
        parse_options(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "cap4d-view me.cap4d --headless --frames 120 --out out.mp4" in text
    assert "space pause" in text


def test_fillers_and_the_sender_go_to_what_opens_a_live_source():
    options = parse_options(["--drive", "tcp://:9000", "--no-blink", "--no-neck", "--sender", "flame.npz"])
    assert options.fill == {"blink": False, "gaze": True, "neck": False}
    driving = {"template": None, "fps": None, "sender": Path("flame.npz"), "fill": options.fill}
    assert options.driving == driving
