"""Draws the overlays with the OpenGL driver the environment selects: `python gl_overlays.py OUT.npz`."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache

import numpy as np
from gl_drivers import context_or_exit
from gl_scenes import view
from tiny_bundle import tiny_bundle

from cap4d.camera import Camera
from cap4d.player.avatar import Avatar
from cap4d.rig.grid import mesh_grid

FACES = 12  # single triangles that are drawn alone
CLOSE = 0.56  # m


@cache
def avatar() -> Avatar:
    bundle = tiny_bundle(12, sh_degree=1, network=False)
    moved = 1e-3 * np.sin(bundle.grid.pixels[:, :1] * [0.5, 0.7, 0.9]).astype(np.float32)
    return Avatar(replace(bundle, deform_neutral=moved))


def near() -> Camera:
    """Triangles are 20 px and more; off centre, not square."""
    camera = view(10, -6, CLOSE, 260, 200)
    K = camera.K.copy()
    K[:2, 2] += 7.3, -4.6
    return replace(camera, K=K)


def lone_faces() -> list[int]:
    """Triangles that face the camera, in the picture, spread over it."""
    camera, faces = near(), avatar().bundle.grid.faces
    at = camera.project(avatar().move(avatar().idle.frame(2)).astype(np.float64))[faces]
    inside = ((at[..., :2] > 4) & (at[..., :2] < [camera.width - 4, camera.height - 4])).all((1, 2))
    a, b = at[:, 1, :2] - at[:, 0, :2], at[:, 2, :2] - at[:, 0, :2]
    area = 0.5 * (a[:, 1] * b[:, 0] - a[:, 0] * b[:, 1])  # clockwise is outside
    longest = np.linalg.norm(at[..., :2] - np.roll(at[..., :2], 1, 1), axis=-1).max(1)
    fit = np.flatnonzero(inside & (area > 60) & (area > 0.25 * longest**2))  # no slivers
    return fit[:: max(1, len(fit) // FACES)][:FACES].tolist()


def draw_on_gl(output: str) -> None:
    from cap4d.app.overlays.overlays import Overlay, Overlays
    from cap4d.app.overlays.surface_pass import SurfacePass
    from cap4d.app.renderers import CpuRenderer, GlRenderer

    ctx = context_or_exit()
    found = {"driver": np.array(ctx.info["GL_RENDERER"])}
    player, camera, frame = avatar(), near(), avatar().idle.frame(2)
    vertices = player.vertices(frame.expr, eye_rot=frame.eye_rot, neck_rot=frame.neck_rot)
    grid = player.bundle.grid

    def pixels(texture) -> np.ndarray:
        return np.frombuffer(texture.read(), np.uint8).reshape(texture.height, texture.width, 4)

    def surface(faces: np.ndarray, samples: int, name: str = "overlay_uv") -> np.ndarray:
        passes = SurfacePass(ctx, replace(grid, faces=faces), samples=samples)
        passes.begin(vertices, camera)
        passes.draw(name, uniforms={"grid_size": float(grid.size)} if name == "overlay_uv" else None)
        return pixels(passes.end())

    for index in lone_faces():
        for samples in (0, 4):
            found[f"face {index} {samples}"] = surface(grid.faces[index : index + 1], samples)[..., 3]
    found["mesh"] = surface(grid.faces, 0, "overlay_mesh")
    found["lone mesh"] = surface(grid.faces[lone_faces()[3]][None], 0, "overlay_mesh")
    inside_out = grid.faces[lone_faces()[3]][None, ::-1]
    found["inside out"] = surface(np.ascontiguousarray(inside_out), 0, "overlay_mesh")
    wire = SurfacePass(ctx, mesh_grid(grid.faces[lone_faces()[3]][None], len(grid)), samples=0)
    wire.begin(vertices, camera)
    wire.draw("overlay_wire")
    found["lone wire"] = pixels(wire.end())
    found["outline"] = surface(grid.faces, 0)[..., 3]

    for renderer in (GlRenderer(ctx, player), CpuRenderer(ctx, player, background=None)):
        overlays = Overlays(ctx, player)
        renderer.texture(frame, camera)
        for kinds in ("", "mesh", "uv", "density", "deformation", "density+deformation+uv+mesh"):
            target = ctx.simple_framebuffer((camera.width, camera.height))
            target.use()
            target.clear(0.25, 0.5, 0.75, 1.0)
            overlays.shown = {Overlay(kind) for kind in kinds.split("+") if kind}
            overlays.draw(renderer, camera, upright=False)
            assert ctx.fbo is target and ctx.viewport == (0, 0, camera.width, camera.height)
            shown = np.frombuffer(target.read(components=4), np.uint8)
            found[f"{renderer.name} {kinds}"] = shown.reshape(camera.height, camera.width, 4)
        overlays.shown = {Overlay.DENSITY}
        counts = overlays._density.counts(renderer)
        found[f"{renderer.name} counts"] = np.frombuffer(counts.read(), np.float32).reshape(
            camera.height, camera.width
        )
    assert ctx.error == "GL_NO_ERROR"
    np.savez(output, **found)


if __name__ == "__main__":
    draw_on_gl(sys.argv[1])
