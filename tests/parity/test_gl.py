"""OpenGL draws what the CPU renderer draws, on every software driver of Mesa."""

import re
from pathlib import Path

import numpy as np
import pytest
from cap4d.app.splat_pass import render_constants
from gl_drivers import DRIVERS, drawn_with
from gl_scenes import SCENES, avatar_views, scene
from tiny_bundle import tiny_bundle

from cap4d.player.avatar import Avatar

# Least PSNR on white, dB, and largest difference of a channel. Float blending and the tiles' arithmetic agree
# to rounding, except that one alone may skip a contribution near 1/255, and that blending cannot stop.
TOLERANCE = {
    "default": (65, 1.5 / 255),
    "opaque": (55, 1e-2),  # a pixel stops with up to 1 % of its light left where alpha is clamped at 0.99
    "degenerate": (50, 0.05),  # the frame of a triangle without area is rounding, normalised
    "half": (50, 2.5 / 255),  # RGBA16F
}


@pytest.fixture(scope="session", params=DRIVERS)
def pictures(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, np.ndarray]:
    """What gl_scenes.py draws with one driver, in a process of its own."""
    return drawn_with(request.param, "gl_scenes.py", tmp_path_factory.mktemp("gl") / "pictures.npz")


def test_the_shaders_constants_are_those_of_the_cpu_renderer():
    header = (Path(__file__).parents[2] / "src/cpp/constants.h").read_text()
    for name, value in render_constants().items():
        camel = "k" + name.title().replace("_", "")
        numerator, denominator = re.search(rf" {camel} = ([\d.e-]+)f?(?: / ([\d.e-]+)f?)?;", header).groups()
        assert np.float32(value) == np.float32(numerator) / np.float32(denominator or 1), name


def on_white(picture: np.ndarray) -> np.ndarray:
    return picture[..., :3] + 1 - picture[..., 3:]


def psnr(a: np.ndarray, b: np.ndarray, peak: float = 1.0) -> float:
    error = np.mean((a.astype(np.float64) - b) ** 2)
    return float(10 * np.log10(peak**2 / max(error, 1e-12)))


@pytest.mark.parametrize("name", [*SCENES, "half thousands"])
def test_a_scene_looks_the_same(name, pictures):
    expected = scene(name.removeprefix("half ")).on_cpu()
    least, most = TOLERANCE.get(name.split()[0], TOLERANCE["default"])
    found = pictures[name]
    assert found.shape == expected.shape
    assert np.abs(on_white(found) - on_white(expected)).max() <= most
    assert psnr(on_white(found), on_white(expected)) >= least


def test_the_scenes_show_something():
    """Else every renderer that draws nothing would pass."""
    for name in SCENES:
        picture = scene(name).on_cpu()
        assert picture[..., 3].max() > 0.015, name
        assert name == "one pixel" or on_white(picture).std() > 0.002, name


def test_no_gaussians_are_no_picture(pictures):
    assert not pictures["empty"].any()


def test_frames_of_an_avatar_are_those_of_the_cpu_renderer(pictures):
    avatar = Avatar(tiny_bundle(24, sh_degree=2, network=False))
    for index, camera in enumerate(avatar_views()):
        expected = avatar.draw(avatar.idle.frame(index), camera, background=(1, 1, 1))
        found = pictures[f"avatar {index}"]
        assert found.dtype == np.uint8
        assert found.shape == expected.shape
        assert np.abs(found.astype(int) - expected).max() <= 2
        assert psnr(found, expected, 255) >= 60
