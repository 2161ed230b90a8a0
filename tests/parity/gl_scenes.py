"""The scenes of test_gl.py, and a program that draws them with the OpenGL driver the environment selects.

A driver is chosen when its library is loaded, so each one gets a process: `python gl_scenes.py OUT.npz`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np
from cap4d import _core
from cap4d.bind import bind_fast
from cap4d.camera import Camera, orbit_camera
from cap4d.gaussians import Gaussians
from cap4d.player.avatar import Avatar
from cap4d.render import render

from tiny_bundle import tiny_bundle

NO_DRIVER = 77  # exit code


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


def scenes() -> dict[str, Scene]:
    """By name. What a name starts with says what may go wrong there."""
    rng = np.random.default_rng(5)
    plain = ball(view())
    n = len(plain.means)
    dark = np.full_like(plain.sh, 0)
    dark[:, 0] = -0.45 / 0.28209479177387814
    odd_quats = plain.quats * rng.choice([1e-12, 1e-3, 1, 50], (n, 1)).astype(np.float32)
    odd_quats[::17] = 0
    needles = plain.log_scales + np.float32([2.2, -3.5, -3.5])
    return {
        **{f"degree {degree}": ball(view(30, -15), sh_degree=degree, index=degree) for degree in range(4)},
        "side": ball(view(95, 10, width=200, height=120), index=3),
        "behind": ball(view(180, -30, width=97, height=131), index=4),
        "near": ball(view(20, 5, 0.16), index=5),
        "inside": ball(view(180, 0, 0.02)),
        "far": ball(view(0, 0, 9.0), index=6),
        "one pixel": ball(view(width=1, height=1)),
        "off centre": replace(plain, camera=view().cropped(70, -30, 120, 150)),
        "thousands": ball(view(-25, 12, 0.5, 224, 224), 48, sh_degree=3, gaussians=2, index=7),
        "opaque": replace(plain, opacity_logits=np.full(n, 12, np.float32), sh=dark),
        "faint": replace(plain, opacity_logits=np.full(n, -4.5, np.float32)),
        "needles": replace(plain, log_scales=needles),
        "blobs": replace(plain, log_scales=plain.log_scales + np.float32(2)),
        "odd quaternions": replace(plain, quats=odd_quats),
        "degenerate": degenerate(plain),
    }


def draw_on_gl(output: str) -> None:
    """Writes every scene's premultiplied picture, an avatar's frames, and the driver's name."""
    from cap4d.app.gl_context import GlUnavailableError, headless_context
    from cap4d.app.renderers import GlRenderer
    from cap4d.app.splat_pass import BoundGaussians, SplatPass

    try:
        ctx = headless_context()
    except GlUnavailableError as error:
        print(error, file=sys.stderr)
        raise SystemExit(NO_DRIVER) from None
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

    for name, scene in scenes().items():
        pictures[name] = draw(scene)
    pictures["half thousands"] = draw(scenes()["thousands"], "f2")
    nothing = {
        n: getattr(scene, n)[:0] for n in ("means", "quats", "log_scales", "opacity_logits", "sh", "binding")
    }
    pictures["empty"] = draw(replace(scene, **nothing))
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
