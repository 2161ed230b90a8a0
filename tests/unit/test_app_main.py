"""cap4d-view without a window, from the command line to the files."""

import json

import numpy as np
import pytest
from cap4d.app.gl_context import GlUnavailableError, headless_context
from cap4d.app.headless import choose_backend
from cap4d.app.main import main
from tiny_bundle import tiny_bundle

from cap4d import cli
from cap4d.bundle import write_bundle
from cap4d.errors import ArgumentError
from cap4d.player.avatar import Avatar
from cap4d.player.offline import draw_on_cpu


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A current folder that holds tiny.cap4d."""
    write_bundle(tiny_bundle(), tmp_path / "tiny.cap4d")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def needs_gl():
    try:
        headless_context().release()
    except GlUnavailableError as error:
        pytest.skip(str(error))


def decoded(path):
    import av

    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


@pytest.mark.parametrize("backend", ["cpu", "gl"])
def test_a_video_and_its_statistics(folder, backend, needs_gl):
    line = (
        f"tiny.cap4d --headless --backend {backend} --frames 6 --size 96x64 --out out.mp4 --stats stats.json"
    )
    assert main(line.split()) == 0
    video = decoded(folder / "out.mp4")
    assert video.shape == (6, 64, 96, 3)
    assert (video[:, :4, :4] > 250).all()
    assert video[0].std() > 10
    assert (video[0] != video[3]).any()
    stats = json.loads((folder / "stats.json").read_text())
    assert (stats["backend"], stats["frames"], stats["width"], stats["height"]) == (backend, 6, 96, 64)
    assert {"rig", "deform", "bind", "splat", "frame"} <= set(stats["stages"])
    assert set(stats["stages"]["splat"]) == {"median_ms", "p95_ms", "p99_ms"}


def test_without_a_name_the_video_is_named_after_the_avatar(folder):
    assert main(["tiny.cap4d", "--headless", "--backend", "cpu", "--size", "64x64"]) == 0
    assert len(decoded(folder / "tiny.mp4")) == len(tiny_bundle().idle)


def test_without_a_display_it_renders_offline_and_says_so(folder, monkeypatch, caplog):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    caplog.set_level("INFO")
    assert main(["tiny.cap4d", "--frames", "2", "--size", "64x64"]) == 0
    assert (folder / "tiny.mp4").is_file()
    assert "rendering offline instead" in caplog.text


def test_pictures_of_an_orbit(folder):
    line = "tiny.cap4d --headless --camera orbit --frames 2 --size 64x64 --out f_%04d.png --backend cpu"
    assert main(line.split()) == 0
    assert {path.name for path in folder.glob("*.png")} == {"f_0000.png", "f_0001.png"}


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        ("missing.cap4d --headless", 1, "missing.cap4d: file: expected a .cap4d file, found no such file"),
        (". --headless", 1, "found a folder"),
        ("tiny.cap4d --headless --template neutral.npy", 2, "template"),
        ("tiny.cap4d --headless --out one.png", 2, "one.png"),
        ("tiny.cap4d --headless --stats no/s.json", 2, "no/s.json"),
        ("tiny.cap4d --headless --out film.avi", 2, "film.avi"),
        ("tiny.cap4d --headless --drive nothing.wav", 2, "nothing.wav"),
        ("tiny.cap4d --headless --camera nowhere.npz", 2, "nowhere.npz"),
        ("broken.cap4d --headless", 1, "broken.cap4d"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_leaves_nothing(folder, capsys, line, code, words):
    (folder / "broken.cap4d").write_bytes((folder / "tiny.cap4d").read_bytes()[:5000])
    before = sorted(folder.iterdir())
    assert main(line.split()) == code
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert error[0].startswith("cap4d-view: ")
    assert words in error[0]
    assert sorted(folder.iterdir()) == before


def test_an_interrupt_is_code_130_and_leaves_no_file(folder, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("cap4d.player.video.VideoWriter.write", interrupted)
    assert main(["tiny.cap4d", "--headless", "--backend", "cpu", "--size", "64x64"]) == 130
    assert [path.name for path in folder.iterdir()] == ["tiny.cap4d"]


def test_no_argument_plays_the_demo(folder, monkeypatch):
    monkeypatch.setattr("cap4d.demo.demo_avatar_path", lambda: folder / "tiny.cap4d")
    assert (
        main(["--headless", "--frames", "1", "--size", "32x32", "--out", "demo.png", "--backend", "cpu"]) == 0
    )
    assert (folder / "demo.png").is_file()


def test_a_demo_that_cannot_be_made_is_a_clear_line(monkeypatch, capsys):
    def cannot():
        raise ArgumentError("the demo avatar is built once, which needs the extra cap4d[fit]")

    monkeypatch.setattr("cap4d.demo.demo_avatar_path", cannot)
    assert main([]) == 2
    assert "cap4d[fit]" in capsys.readouterr().err


def test_auto_is_the_cpu_where_software_or_nothing_draws(monkeypatch, needs_gl):
    avatar = Avatar(tiny_bundle(network=False))
    monkeypatch.setattr("cap4d.app.renderers.is_software", lambda ctx: True)
    assert choose_backend("auto", avatar) == ("cpu", draw_on_cpu)
    monkeypatch.setattr("cap4d.app.renderers.is_software", lambda ctx: False)
    assert choose_backend("auto", avatar)[0] == "gl"

    def unavailable():
        raise GlUnavailableError("none")

    monkeypatch.setattr("cap4d.app.renderers.headless_context", unavailable)
    assert choose_backend("auto", avatar) == ("cpu", draw_on_cpu)
    with pytest.raises(GlUnavailableError):
        choose_backend("gl", avatar)


@pytest.mark.parametrize("avatar", ["missing.cap4d", "."])
def test_every_program_says_the_same_of_a_missing_avatar(folder, capsys, avatar):
    lines = []
    for run, words in (
        (main, [avatar]),
        (cli.main, ["inspect", avatar]),
        (cli.main, ["render", avatar, "-o", "a.mp4"]),
    ):
        assert run(words) == 1
        lines.append(capsys.readouterr().err.partition(": ")[2])
    assert len(set(lines)) == 1
    assert lines[0].startswith(f"{avatar}: file: expected a .cap4d file, found ")


def test_render_and_view_draw_the_same_pictures(folder):
    words = ["tiny.cap4d", "--fps", "12", "--size", "40X30", "--camera", "orbit"]
    assert main([*words, "--headless", "--backend", "cpu", "--out", "view_%02d.png"]) == 0
    assert cli.main(["render", *words, "-o", "render_%02d.png"]) == 0
    names = [f"{i:02d}.png" for i in range(len(tiny_bundle().idle))]
    for name in names:
        assert (folder / f"view_{name}").read_bytes() == (folder / f"render_{name}").read_bytes()
    assert len(list(folder.glob("*.png"))) == 2 * len(names)


def test_a_rate_applies_to_the_idle_clip(folder):
    import av

    assert cli.main(["render", "tiny.cap4d", "--fps", "12", "--size", "40x30", "-o", "a.mp4"]) == 0
    with av.open("a.mp4") as container:
        assert container.streams.video[0].average_rate == 12
        assert container.streams.video[0].frames == len(tiny_bundle().idle)
