"""The scenes of test_gl.py, and a program that draws them with the OpenGL driver the environment selects.

A driver is chosen when its library is loaded, so each one gets a process: `python gl_scenes.py OUT.npz`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from gl_drivers import context_or_exit
from tiny_bundle import tiny_bundle

from cap4d import _core
from cap4d.bind import bind_fast
from cap4d.camera import Camera, opencv_from_rig, orbit_camera
from cap4d.gaussians import Gaussians
from cap4d.player.avatar import Avatar
from cap4d.render import render
from cap4d.rig.builtin import build_head
from cap4d.rig.grid import build_grid, remesh


@dataclass(frozen=True, eq=False)
class Scene:
    """Bound Gaussians, posed vertices and a camera."""

    vertices: np.ndarray
    faces: np.ndarray
    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    binding: np.ndarray
    camera: Camera

    def posed(self) -> Gaussians:
        local = {name: getattr(self, name) for name in ("means", "quats", "log_scales", "binding")}
        opacities = (1 / (1 + np.exp(-self.opacity_logits.astype(np.float64)))).astype(np.float32)
        return Gaussians(*bind_fast(self.vertices, self.faces, **local), opacities, self.sh)

    def on_cpu(self) -> np.ndarray:
        """float32[H, W, 4] premultiplied."""
        drawn = render(self.posed(), self.camera, background=None)
        return np.concatenate([drawn.rgb, drawn.alpha[..., None]], -1)


def view(yaw=0.0, pitch=0.0, distance=0.7, width=160, height=160) -> Camera:
    target, fov = np.zeros(3), 25.0
    return orbit_camera(
        yaw_deg=yaw,
        pitch_deg=pitch,
        distance=distance,
        target=target,
        fov_y_deg=fov,
        width=width,
        height=height,
    )


def ball(camera: Camera, size: int = 16, *, index: int = 0, **settings) -> Scene:
    """The tiny bundle in frame `index` of its clip."""
    bundle = tiny_bundle(size, network=False, **settings)
    frame = bundle.idle.frame(index)
    vertices = Avatar(bundle).vertices(frame.expr, eye_rot=frame.eye_rot, neck_rot=frame.neck_rot)
    names = ("means", "quats", "log_scales", "opacity_logits", "sh", "binding")
    return Scene(vertices, bundle.grid.faces, **{n: getattr(bundle, n) for n in names}, camera=camera)


def degenerate(scene: Scene) -> Scene:
    """Triangles that are a point, a line, and one whose first edge has no length; all of them visible."""
    vertices = scene.vertices.copy()
    for i, (a, b, c) in enumerate(scene.faces[:: len(scene.faces) // 12][:12]):
        if i % 3 == 0:
            vertices[[b, c]] = vertices[a]
        elif i % 3 == 1:
            vertices[c] = vertices[a] + 2 * (vertices[b] - vertices[a])
        else:
            vertices[b] = vertices[a]
    return replace(scene, vertices=vertices)


def head(camera: Camera) -> Scene:
    """The built-in head, smiling with open mouth: two Gaussians on every triangle, in its own colours."""
    rig = build_head()
    grid = build_grid(rig)
    on_grid = remesh(rig, grid)
    expr = np.zeros(rig.n_expressions, np.float32)
    expr[[rig.expression_names.index(name) for name in ("mouthSmileLeft", "mouthSmileRight", "jawOpen")]] = (
        0.5
    )
    binding = np.repeat(np.arange(len(grid.faces), dtype=np.int32), 2)
    rng, n = np.random.default_rng(1), len(binding)
    colors = on_grid.colors[grid.faces[binding]].mean(1)
    return Scene(
        vertices=opencv_from_rig(on_grid.subject().pose(expr)).astype(np.float32),
        faces=grid.faces,
        means=rng.uniform(-0.4, 0.4, (n, 3)).astype(np.float32) * np.float32([1, 0.1, 1]),
        quats=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        log_scales=np.tile(np.log(np.float32([0.5, 0.1, 0.5])), (n, 1)),
        opacity_logits=rng.uniform(0, 3, n).astype(np.float32),
        sh=((colors - 0.5) / 0.28209479177387814).astype(np.float32)[:, None],
        binding=binding,
        camera=camera,
    )


def plain() -> Scene:
    return ball(view())


def opaque() -> Scene:
    """Black and solid: what is behind a pixel's last Gaussian shows as much as it can."""
    scene = plain()
    dark = np.zeros_like(scene.sh)
    dark[:, 0] = -0.45 / 0.28209479177387814
    return replace(scene, opacity_logits=np.full(len(dark), 12, np.float32), sh=dark)


def faint() -> Scene:
    """Opacities of 0.011, three times what is visible at all."""
    return replace(plain(), opacity_logits=np.full(len(plain().means), -4.5, np.float32))


def odd_quaternions() -> Scene:
    """Of all lengths, and none."""
    quats = plain().quats * np.random.default_rng(5).choice([1e-11, 1e-3, 1, 50], (len(plain().quats), 1))
    quats[::17] = 0
    return replace(plain(), quats=quats.astype(np.float32))


def scaled(factors: list[float]) -> Scene:
    return replace(plain(), log_scales=plain().log_scales + np.log(factors).astype(np.float32))


# By name; what a name starts with says what may go wrong there.
SCENES: dict[str, Callable[[], Scene]] = {
    **{f"degree {d}": lambda d=d: ball(view(30, -15), sh_degree=d, index=d) for d in range(4)},
    "side": lambda: ball(view(95, 10, width=200, height=120), index=3),
    "behind": lambda: ball(view(180, -30, width=97, height=131), index=4),
    "near": lambda: ball(view(20, 5, 0.16), index=5),
    "inside": lambda: ball(view(180, 0, 0.02)),
    "far": lambda: ball(view(0, 0, 9.0), index=6),
    "one pixel": lambda: ball(view(width=1, height=1)),
    "off centre": lambda: replace(plain(), camera=view().cropped(70, -30, 120, 150)),
    "thousands": lambda: ball(view(-25, 12, 0.5, 224, 224), 48, sh_degree=3, gaussians=2, index=7),
    "head": lambda: head(view(0, 0, 0.9, 256, 256)),
    "head from the side": lambda: head(view(-60, 10, 0.9, 256, 256)),
    "opaque": opaque,
    "faint": faint,
    "needles": lambda: scaled([9, 0.03, 0.03]),
    "blobs": lambda: scaled([7, 7, 7]),
    "odd quaternions": odd_quaternions,
    "degenerate": lambda: degenerate(plain()),
}


@cache
def scene(name: str) -> Scene:
    return SCENES[name]()


def draw_on_gl(output: str) -> None:
    """Writes every scene's premultiplied picture, an avatar's frames, and the driver's name."""
    from cap4d.app.renderers import GlRenderer
    from cap4d.app.splat_pass import BoundGaussians, SplatPass

    ctx = context_or_exit()
    pictures = {"driver": np.array(ctx.info["GL_RENDERER"])}

    def draw(scene: Scene, texture_type: str = "f4") -> np.ndarray:
        names = ("means", "quats", "log_scales", "opacity_logits", "sh")
        local = {name: getattr(scene, name) for name in names}
        triangles = scene.faces[scene.binding]
        bound = BoundGaussians(**local, triangles=triangles, grid_size=len(scene.vertices))
        splats = SplatPass(ctx, bound, texture_type=texture_type)
        order = _core.sort_by_depth(scene.posed().means, scene.camera.viewmat.astype(np.float32))
        splats.draw(scene.vertices, order, scene.camera)
        return splats.read()

    for name in SCENES:
        pictures[name] = draw(scene(name))
    pictures["half thousands"] = draw(scene("thousands"), "f2")
    nothing = {
        n: getattr(plain(), n)[:0]
        for n in ("means", "quats", "log_scales", "opacity_logits", "sh", "binding")
    }
    pictures["empty"] = draw(replace(plain(), **nothing))
    avatar = Avatar(tiny_bundle(24, sh_degree=2, network=False))
    renderer = GlRenderer(ctx, avatar)
    for index, camera in enumerate(avatar_views()):
        pictures[f"avatar {index}"] = renderer.draw(avatar.idle.frame(index), camera)
    assert ctx.error == "GL_NO_ERROR"
    np.savez(output, **pictures)


def avatar_views() -> list[Camera]:
    """A size of picture for each frame: targets are made anew in between."""
    return [view(20 * i, 0, 0.6, 64 + 30 * (i % 2), 100) for i in range(4)]


if __name__ == "__main__":
    draw_on_gl(sys.argv[1])
