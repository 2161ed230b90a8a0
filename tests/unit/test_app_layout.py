"""The window shared out."""

import pytest
from cap4d.app.layout import Rect, share_out


@pytest.mark.parametrize("size", [(1180, 760), (640, 400), (420, 280), (3840, 2160)])
@pytest.mark.parametrize("scale", [1.0, 1.5])
@pytest.mark.parametrize("sidebar", [True, False])
def test_nothing_covers_the_picture_and_nothing_is_left_over(size, scale, sidebar):
    layout = share_out(size, scale, panels=True, sidebar=sidebar)
    rects = [r for r in (layout.picture, layout.menu, layout.sidebar, layout.transport) if r is not None]
    assert sum(r.width * r.height for r in rects) == size[0] * size[1]
    for i, a in enumerate(rects):
        assert min(a.x, a.y) >= 0
        assert a.x + a.width <= size[0]
        assert a.y + a.height <= size[1]
        for b in rects[:i]:
            apart_x = a.x + a.width <= b.x or b.x + b.width <= a.x
            apart_y = a.y + a.height <= b.y or b.y + b.height <= a.y
            assert apart_x or apart_y


@pytest.mark.parametrize("size", [(0, 0), (1, 1), (200, 160), (1000, 100)])
def test_a_small_window_is_all_picture(size):
    layout = share_out(size, 1.0, panels=True, sidebar=True)
    assert layout.picture == Rect(0, 0, max(size[0], 1), max(size[1], 1))
    assert layout.menu is layout.sidebar is layout.transport is None


def test_panels_can_be_hidden():
    assert share_out((1180, 760), 1.0, panels=False, sidebar=True).picture == Rect(0, 0, 1180, 760)
    assert share_out((1180, 760), 1.0, panels=True, sidebar=False).sidebar is None


def test_pixels_count_from_below():
    assert Rect(10, 20, 30, 40).in_pixels((100, 100), (200, 200)) == (20, 80, 60, 80)
    assert Rect(0, 0, 1, 1).in_pixels((0, 0), (0, 0)) == (0, 0, 0, 0)
