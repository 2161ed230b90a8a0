"""All overlays of one avatar, and which of them are shown."""

from __future__ import annotations

from enum import StrEnum

import moderngl
import numpy as np
from cap4d.app.background import Backdrop
from cap4d.app.overlays.color_map import color_map
from cap4d.app.overlays.density import DensityOverlay, color_texture
from cap4d.app.overlays.legend import Legend, rounded_up, ticks
from cap4d.app.overlays.surface_pass import SurfacePass
from cap4d.app.renderers import Renderer

from cap4d.bundle.bundle import Bundle
from cap4d.camera import Camera
from cap4d.player.avatar import Avatar

SHARE = 98.0  # per cent of the vertices whose deformation is within the colours


class Overlay(StrEnum):
    """In the order in which they are drawn."""

    DENSITY = "density"
    DEFORMATION = "deformation"
    UV = "uv"
    MESH = "mesh"


class Part(StrEnum):
    """Of the deformation."""

    ALL = "all"  # with what is there in the neutral face
    EXPRESSION = "expression"


def why_not(overlay: Overlay, bundle: Bundle) -> str:
    """Why an avatar has nothing for an overlay to show, or nothing."""
    if bundle.grid.is_mesh and overlay is Overlay.UV:
        return "This avatar's Gaussians ride on the rig's own triangles: it has no UV grid"
    if bundle.grid.is_mesh and overlay is Overlay.DEFORMATION:
        return "This avatar has no network: nothing but the rig moves it"
    return ""


class Overlays:
    """Draws what is in `shown`, if the avatar has it. What was never shown costs nothing.

    Args:
        ctx: OpenGL 4.1 or newer.
        avatar: Whose surface and deformation.
    """

    def __init__(self, ctx: moderngl.Context, avatar: Avatar) -> None:
        self.ctx, self.avatar = ctx, avatar
        self.shown: set[Overlay] = set()
        self.part = Part.ALL
        self.limits_mm = dict.fromkeys(
            Part, 0.0
        )  # what the deformation's last colour stands for; it only grows
        self._colors = color_map("viridis")
        self._surface: SurfacePass | None = None
        self._density: DensityOverlay | None = None
        self._backdrop: Backdrop | None = None
        self._map: moderngl.Texture | None = None

    def draw(self, renderer: Renderer, camera: Camera, *, upright: bool = False) -> None:
        """Lays the overlays over what the framebuffer in use holds, filling it.

        Args:
            renderer: Has just drawn the frame.
            camera: Of that picture; for a sharper surface, the same view `resized` to the framebuffer.
            upright: As of `Backdrop.draw`.
        """
        if not self._showing():
            return
        screen, viewport = self.ctx.fbo, self.ctx.viewport
        counts = self._counted(renderer)
        surface = self._drawn(renderer.vertices, camera)
        screen.use()
        self.ctx.viewport = viewport
        if counts is not None:
            self._density.draw(counts, upright=upright)
        if surface is not None:
            self._backdrop = self._backdrop or Backdrop(self.ctx)
            self._backdrop.over(surface, upright=upright)

    def legends(self) -> list[Legend]:
        """Of what is shown."""
        found = []
        if Overlay.DENSITY in self.shown and self._density is not None:
            found.append(self._density.legend)
        if Overlay.DEFORMATION in self._showing():
            title = "Deformation, mm" if self.part is Part.ALL else "Deformation by expression, mm"
            found.append(Legend(title, self._colors, ticks(self.limits_mm[self.part] or 1.0)))
        return found

    def deformation_mm(self) -> np.ndarray:
        """float32[G] how far the deformer moved each vertex in the last frame."""
        moved = self.avatar.deformation()
        if self.part is Part.EXPRESSION:
            moved -= self.avatar.bundle.deform_neutral
        return 1e3 * np.linalg.norm(moved, axis=1)

    def _showing(self) -> set[Overlay]:
        return {overlay for overlay in self.shown if not why_not(overlay, self.avatar.bundle)}

    def _counted(self, renderer: Renderer) -> moderngl.Texture | None:
        if Overlay.DENSITY not in self.shown:
            return None
        self._density = self._density or DensityOverlay(self.ctx)
        return self._density.counts(renderer)

    def _drawn(self, vertices: np.ndarray, camera: Camera) -> moderngl.Texture | None:
        showing = self._showing()
        if not showing - {Overlay.DENSITY}:
            return None
        self._surface = self._surface or SurfacePass(self.ctx, self.avatar.bundle.grid)
        self._surface.begin(vertices, camera)
        if Overlay.DEFORMATION in showing:
            self._draw_deformation(self._surface)
        if Overlay.UV in showing:
            self._surface.draw("overlay_uv", uniforms={"grid_size": float(self._surface.grid_size)})
        if Overlay.MESH in showing:
            self._surface.draw("overlay_wire" if self.avatar.bundle.grid.is_mesh else "overlay_mesh")
        return self._surface.end()

    def _draw_deformation(self, surface: SurfacePass) -> None:
        moved = self.deformation_mm()
        limit = max(self.limits_mm[self.part], rounded_up(float(np.percentile(moved, SHARE))))
        self.limits_mm[self.part] = limit
        self._map = self._map or color_texture(self.ctx, self._colors)
        self._map.use(0)
        surface.draw("overlay_values", values=moved, uniforms={"limit": limit, "color_map": 0})
