"""Dear ImGui's context: what the window's input means to it, and what it draws."""

import glfw
import numpy as np
import pytest
from cap4d.app.gui import SETTLE, Gui
from imgui_bundle import imgui

SIZE = 200, 120


class Clipboard:
    text = ""

    def copied(self):
        return self.text

    def copy(self, text):
        self.text = text


@pytest.fixture
def make(ctx):
    made = []

    def make_gui(**settings):
        made.append(Gui(ctx, **settings))
        return made[-1]

    yield make_gui
    for gui in made:
        gui.release()


def picture(ctx, gui, draw, size=SIZE, density=1):
    """uint8[H, W, 3] of a frame whose panels `draw` makes."""
    pixels = size[0] * density, size[1] * density
    target = ctx.simple_framebuffer((max(pixels[0], 1), max(pixels[1], 1)))
    target.use()
    target.clear(1, 1, 1)
    with gui.frame(size, pixels, 1 / 60):
        draw()
    flat = np.frombuffer(target.read(components=3), np.uint8)
    return flat.reshape(*target.size[::-1], 3)[::-1]


def field(state):
    """A window over everything with a text field at its top left."""

    def draw():
        imgui.set_next_window_pos(imgui.ImVec2(0, 0))
        imgui.set_next_window_size(imgui.ImVec2(150, 120))
        imgui.begin("field", None, imgui.WindowFlags_.no_title_bar)
        _, state["text"] = imgui.input_text("##text", state["text"])
        imgui.end()

    return draw


def test_it_knows_what_is_under_the_pointer(ctx, make):
    gui, draw = make(), field({"text": ""})
    picture(ctx, gui, draw)
    for x, over in ((20, True), (180, False)):
        gui.pointer(x, 60)
        picture(ctx, gui, draw)
        picture(ctx, gui, draw)
        assert gui.wants_pointer == over
    assert gui.cursor() is None
    gui.pointer(40, 25)
    picture(ctx, gui, draw)
    picture(ctx, gui, draw)
    assert gui.cursor() == glfw.IBEAM_CURSOR


def press(ctx, gui, draw, key, modifiers=0):
    for down in (True, False):
        gui.key(key, down, modifiers)
        picture(ctx, gui, draw)


def test_typing_copying_and_pasting(ctx, make):
    clipboard, state = Clipboard(), {"text": ""}
    gui, draw = make(clipboard=clipboard), field(state)
    picture(ctx, gui, draw)
    gui.pointer(40, 25)
    for down in (True, False):
        gui.button(glfw.MOUSE_BUTTON_LEFT, down)
        picture(ctx, gui, draw)
    assert gui.wants_keys
    for letter in "smile":
        gui.text(ord(letter))
        picture(ctx, gui, draw)
    assert state["text"] == "smile"
    for key in (glfw.KEY_A, glfw.KEY_C):
        press(ctx, gui, draw, key, glfw.MOD_CONTROL)
    assert clipboard.text == "smile"
    press(ctx, gui, draw, glfw.KEY_END)
    press(ctx, gui, draw, glfw.KEY_V, glfw.MOD_CONTROL)
    assert state["text"] == "smilesmile"
    press(ctx, gui, draw, glfw.KEY_ESCAPE)
    picture(ctx, gui, draw)
    assert not gui.wants_keys


def test_a_dense_display_gets_sharper_and_not_smaller_letters(ctx, make):
    gui = make()
    draw = field({"text": "mm"})
    for _ in range(3):
        once, twice = picture(ctx, gui, draw), picture(ctx, gui, draw, density=2)
    assert twice.shape == (240, 400, 3)
    averaged = twice.reshape(120, 2, 200, 2, 3).mean((1, 3))
    assert np.abs(averaged - once).mean() < 4


def test_a_scale_makes_everything_larger(ctx, make):
    heights = []
    for scale in (1.0, 2.0):
        gui = make(scale=scale)
        picture(ctx, gui, lambda: heights.append(imgui.get_frame_height()))
    assert heights[1] == pytest.approx(2 * heights[0], rel=0.05)


@pytest.mark.parametrize("size", [(0, 0), (1, 1), (1, 500)])
def test_a_window_of_no_size_is_drawn(ctx, make, size):
    picture(ctx, make(), field({"text": ""}), size)


def test_it_stands_still_some_pictures_after_an_input(ctx, make):
    gui = make()
    for _ in range(SETTLE):
        assert gui.is_moving
        picture(ctx, gui, lambda: None)
    assert not gui.is_moving
    gui.focus(False)
    assert gui.is_moving


def test_buttons_that_nobody_knows_are_ignored(make):
    gui = make()
    gui.button(77, True)
    gui.key(glfw.KEY_UNKNOWN, True, 0)
