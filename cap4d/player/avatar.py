"""A playing avatar: an expression in, posed Gaussians or a picture out. No torch."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from cap4d import _core
from cap4d.bind import bind_fast
from cap4d.bundle.bundle import Bundle
from cap4d.bundle.reader import read_bundle
from cap4d.camera import Camera
from cap4d.drive.clip import Clip, Frame
from cap4d.errors import ArgumentError
from cap4d.gaussians import Gaussians
from cap4d.player.stages import Stages
from cap4d.player.surface import Surface
from cap4d.player.tiers import BUDGET_MS, choose_tier, moving_subject

Tier = Literal["auto", "full", "fp16", "int8", "linear", "off"]
Alpha = Literal["straight", "premultiplied"]


class Avatar:
    """A bundle that is ready to play. Not for use from two threads at once.

    Args:
        bundle: The avatar.
        deformer: How the network is evaluated: `full`, `fp16` or `int8` run it, `linear` adds what was
            learned of it to the expressions, `off` leaves its neutral correction only. `auto`: the most exact
            that keeps up on this machine (`tiers.choose_tier`).
        threads: For the network and the renderer; 0: see `deformer.default_threads`.
        source: The file it came from, for error messages.
        deformer_budget_ms: What a pass may take for `auto`; infinity is the most exact, unmeasured.
    Raises:
        ArgumentError: The bundle does not have that deformer.
        DataError: Its network does not load.
    """

    def __init__(
        self,
        bundle: Bundle,
        *,
        deformer: Tier = "auto",
        threads: int = 0,
        source: str = "avatar",
        deformer_budget_ms: float = BUDGET_MS,
    ) -> None:
        self.bundle, self.threads = bundle, threads
        self.stages = Stages()
        self.tier, self.deformer = choose_tier(
            bundle, deformer, threads=threads, source=source, budget_ms=deformer_budget_ms
        )
        self.surface = Surface(moving_subject(bundle, self.tier), bundle, self.deformer, threads=threads)
        self._opacities = _sigmoid(bundle.opacity_logits)
        # Neighbours on the surface lie side by side in memory.
        self.gaussian_order = np.argsort(bundle.binding, kind="stable")
        self.splatter = _splatter(bundle, self._opacities, self.gaussian_order)
        # In turns: a picture can be drawn from one frame's vertices while the next frame's are made.
        self._vertices = [np.empty((len(bundle.grid), 3), np.float32) for _ in range(2)]

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        deformer: Tier = "auto",
        threads: int = 0,
        deformer_budget_ms: float = BUDGET_MS,
    ) -> Avatar:
        """Reads a `.cap4d` file.

        Raises:
            ArgumentError: It does not have that deformer.
            DataError: It is not sound; see `cap4d.bundle.read_bundle`.
        """
        return cls(
            read_bundle(path),
            deformer=deformer,
            threads=threads,
            source=str(path),
            deformer_budget_ms=deformer_budget_ms,
        )

    @property
    def camera(self) -> Camera:
        """The default view, in the head-fixed world."""
        return self.bundle.camera

    @property
    def idle(self) -> Clip:
        """What plays when nothing drives the avatar."""
        return self.bundle.idle

    @property
    def rig_name(self) -> str:
        """Whose expression vectors it takes."""
        return self.bundle.rig_name

    def vertices(
        self,
        expr: np.ndarray,
        *,
        eye_rot: np.ndarray | None = None,
        neck_rot: np.ndarray | None = None,
        jaw_rot: np.ndarray | None = None,
    ) -> np.ndarray:
        """Posed grid vertices with their deformation (facts 20, 24).

        Args:
            expr: [E] in the expression space of `rig_name`.
            eye_rot, neck_rot, jaw_rot: [3] axis-angle, rad; None is no rotation.
        Returns:
            float32[G, 3] m, head frame, OpenCV axes.
        Raises:
            ArgumentError: A wrong length, or a number that is not finite.
        """
        out = np.empty((len(self.bundle.grid), 3), np.float32)
        self._pose(out, expr, eye_rot=eye_rot, neck_rot=neck_rot, jaw_rot=jaw_rot)
        return out

    def deformation(self) -> np.ndarray:
        """float32[G, 3] m, OpenCV axes: how far the deformer moved the grid's vertices in the last frame.

        Worked out when asked for; `bundle.deform_neutral` is the part of it that is there without expression.
        """
        return self.surface.deformation()

    def move(self, frame: Frame) -> np.ndarray:
        """`vertices` of a driven frame, in the avatar's own memory: the call after the next overwrites it."""
        self.check_rig(frame.rig_name)
        self._vertices.reverse()
        rotations = {name: getattr(frame, name) for name in ("eye_rot", "neck_rot", "jaw_rot")}
        self._pose(self._vertices[0], frame.expr, **rotations)
        return self._vertices[0]

    def pose(
        self,
        expr: np.ndarray,
        *,
        eye_rot: np.ndarray | None = None,
        neck_rot: np.ndarray | None = None,
        jaw_rot: np.ndarray | None = None,
    ) -> Gaussians:
        """The Gaussians of an expression, head frame, OpenCV axes (fact 27). Arguments as of `vertices`."""
        bundle = self.bundle
        vertices = self.vertices(expr, eye_rot=eye_rot, neck_rot=neck_rot, jaw_rot=jaw_rot)
        with self.stages.time("bind"):
            local = {name: getattr(bundle, name) for name in ("means", "quats", "log_scales", "binding")}
            posed = bind_fast(vertices, bundle.grid.faces, **local, threads=self.threads)
        return Gaussians(*posed, self._opacities, bundle.sh)

    def render(
        self,
        expr: np.ndarray,
        camera: Camera | None = None,
        *,
        background: tuple[float, float, float] | None = None,
        eye_rot: np.ndarray | None = None,
        neck_rot: np.ndarray | None = None,
        jaw_rot: np.ndarray | None = None,
    ) -> np.ndarray:
        """A picture.

        Args:
            expr, eye_rot, neck_rot, jaw_rot: As of `vertices`.
            camera: In the head-fixed world; None is the default view.
            background: sRGB in [0, 1] to composite on; None leaves straight (not premultiplied) alpha.
        Returns:
            uint8[H, W, 4] sRGB and alpha (255 everywhere with a background).
        """
        vertices = self._vertices[0]
        self._pose(vertices, expr, eye_rot=eye_rot, neck_rot=neck_rot, jaw_rot=jaw_rot)
        return self.splat(vertices, self.camera if camera is None else camera, background=background)

    def splat(
        self,
        vertices: np.ndarray,
        camera: Camera,
        *,
        background: tuple[float, float, float] | None = None,
        out: np.ndarray | None = None,
        alpha: Alpha = "straight",
    ) -> np.ndarray:
        """The picture of posed vertices; see `render`.

        Args:
            vertices: float32[G, 3] as of `vertices`.
            out: uint8[H, W, 4] to draw into, so that nothing is allocated; None makes one.
            alpha: What a picture without a background has; with one it is opaque.
        """
        if out is None:
            out = np.empty((camera.height, camera.width, 4), np.uint8)
        elif out.shape != (camera.height, camera.width, 4):
            found = list(out.shape)
            raise ArgumentError(f"out: expected uint8[{camera.height}, {camera.width}, 4], got {found}")
        premultiplied = background is None and alpha == "premultiplied"
        self.splatter.draw(
            out, camera.viewmat, camera.K, background, vertices, self.threads, premultiplied=premultiplied
        )
        parts = self.splatter.seconds
        self.stages.add("bind", parts.pop("bind"))
        self.stages.add("splat", sum(parts.values()))
        for part, seconds in parts.items():
            self.stages.add(part, seconds)
        return out

    def draw(
        self,
        frame: Frame,
        camera: Camera,
        *,
        background: tuple[float, float, float] | None = None,
        out: np.ndarray | None = None,
    ) -> np.ndarray:
        """`render` of a driven frame. Its head pose is the camera's business (`camera.head_fixed`)."""
        return self.splat(self.move(frame), camera, background=background, out=out)

    def check_rig(self, name: str) -> None:
        """Refuses expressions of another rig.

        Raises:
            ArgumentError: Naming both.
        """
        if name != self.rig_name:
            raise ArgumentError(f"rig: expected expressions of {self.rig_name}, got those of {name}")

    def _checked(self, expr: np.ndarray) -> np.ndarray:
        n, name = self.bundle.n_expressions, self.rig_name
        expr = np.asarray(expr)
        if expr.shape != (n,) or expr.dtype.kind not in "fiu":
            raise ArgumentError(f"expr: expected {n} numbers ({name}), got {expr.dtype}{list(expr.shape)}")
        expr = expr.astype(np.float32)
        if not np.isfinite(expr).all():
            raise ArgumentError(f"expr: expected {n} finite numbers ({name}), got one that is not")
        return expr

    def _pose(self, out: np.ndarray, expr: np.ndarray, **rotations: np.ndarray | None) -> None:
        checked = {name: _rotation(name, value) for name, value in rotations.items()}
        self.surface.pose(self._checked(expr), out, **checked, stages=self.stages)


def _splatter(bundle: Bundle, opacities: np.ndarray, order: np.ndarray) -> _core.Splatter:
    rows = (bundle.means, bundle.quats, np.exp(bundle.log_scales), opacities, bundle.sh)
    return _core.Splatter(
        *(np.ascontiguousarray(x[order], np.float32) for x in rows),
        np.ascontiguousarray(bundle.binding[order]),
        bundle.grid.faces,
    )


def _rotation(name: str, value: np.ndarray | None) -> np.ndarray | None:
    """float32[3], or None where there is no rotation."""
    if value is None:
        return None
    value = np.asarray(value, np.float32)
    if value.shape != (3,) or not np.isfinite(value).all():
        raise ArgumentError(f"{name}: expected 3 finite numbers (axis-angle, rad), got {value.tolist()}")
    return value if value.any() else None


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return (0.5 + 0.5 * np.tanh(0.5 * x)).astype(np.float32)
