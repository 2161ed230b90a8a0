"""Where the panels are and where the picture is, so that neither covers the other."""

from __future__ import annotations

from dataclasses import dataclass

SIDEBAR, MENU, TRANSPORT = 328, 30, 50  # units of design
LEAST = 420, 280  # units of design below which a window shows the picture only
LEAST_WITH_SIDEBAR = 640


@dataclass(frozen=True)
class Rect:
    """Window units, y down."""

    x: int
    y: int
    width: int
    height: int

    def in_pixels(self, size: tuple[int, int], pixels: tuple[int, int]) -> tuple[int, int, int, int]:
        """(left, bottom, width, height) in a framebuffer of `pixels` under a window of `size`, y up."""
        sx, sy = pixels[0] / max(size[0], 1), pixels[1] / max(size[1], 1)
        left, top = round(self.x * sx), round(self.y * sy)
        right, bottom = round((self.x + self.width) * sx), round((self.y + self.height) * sy)
        return left, pixels[1] - bottom, right - left, bottom - top


@dataclass(frozen=True)
class Layout:
    """A window shared out; a panel that is not to be seen is None."""

    picture: Rect
    menu: Rect | None
    sidebar: Rect | None
    transport: Rect | None


def share_out(size: tuple[int, int], scale: float, *, panels: bool, sidebar: bool) -> Layout:
    """Shares a window out.

    Args:
        size: Of the window, window units.
        scale: Window units per unit of design.
        panels, sidebar: What the user wants to see; a window that is too small shows less.
    """
    width, height = max(size[0], 1), max(size[1], 1)
    if not panels or width < LEAST[0] * scale or height < LEAST[1] * scale:
        return Layout(Rect(0, 0, width, height), None, None, None)
    menu, transport = round(MENU * scale), round(TRANSPORT * scale)
    side = round(SIDEBAR * scale) if sidebar and width >= LEAST_WITH_SIDEBAR * scale else 0
    middle = height - menu - transport
    return Layout(
        picture=Rect(0, menu, width - side, middle),
        menu=Rect(0, 0, width, menu),
        sidebar=Rect(width - side, menu, side, height - menu) if side else None,
        transport=Rect(0, height - transport, width - side, transport),
    )
