"""A playing avatar: an expression in, posed Gaussians or a picture out. No torch."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from cap4d.bind import bind_fast
from cap4d.bundle.bundle import Bundle
from cap4d.bundle.reader import read_bundle
from cap4d.camera import Camera, opencv_from_rig
from cap4d.drive.clip import Clip, Frame
from cap4d.errors import ArgumentError
from cap4d.gaussians import Gaussians
from cap4d.player.stages import Stages
from cap4d.player.tiers import BUDGET_MS, choose_tier, moving_subject
from cap4d.render import render

Tier = Literal["auto", "full", "fp16", "int8", "linear", "off"]


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
        # Mixing leaves strided arrays, which every product would copy: 45 ms a frame instead of 1 at E = 65.
        self._subject = moving_subject(bundle, self.tier).map(np.ascontiguousarray)
        self._neutral = self._subject.pose(np.zeros(bundle.n_expressions, np.float32))
        self._deformable = bundle.grid.deformable[:, None]
        self._opacities = _sigmoid(bundle.opacity_logits)

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
        subject = self._subject
        expr = self._checked(expr)
        rotations = {"eye_rot": _rotation("eye_rot", eye_rot), "jaw_rot": _rotation("jaw_rot", jaw_rot)}
        neck_rot = _rotation("neck_rot", neck_rot)
        with self.stages.time("rig"):
            straight = subject.pose(expr, **rotations)
            posed = straight if neck_rot is None else subject.pose(expr, neck_rot=neck_rot, **rotations)
        with self.stages.time("deform"):
            return opencv_from_rig(posed) + self._deformation(straight, rotations["jaw_rot"])

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
        gaussians = self.pose(expr, eye_rot=eye_rot, neck_rot=neck_rot, jaw_rot=jaw_rot)
        camera = self.camera if camera is None else camera
        with self.stages.time("splat"):
            drawn = render(gaussians, camera, background=background or (0.0, 0.0, 0.0), threads=self.threads)
        with self.stages.time("encode"):
            return _rgba8(drawn.rgb, drawn.alpha, straight=background is None)

    def draw(
        self, frame: Frame, camera: Camera, *, background: tuple[float, float, float] | None = None
    ) -> np.ndarray:
        """`render` of a driven frame. Its head pose is the camera's business (`camera.head_fixed`)."""
        self.check_rig(frame.rig_name)
        rotations = {name: getattr(frame, name) for name in ("eye_rot", "neck_rot", "jaw_rot")}
        return self.render(frame.expr, camera, background=background, **rotations)

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

    def _deformation(self, straight: np.ndarray, jaw_rot: np.ndarray | None) -> np.ndarray:
        """[G, 3] m, OpenCV axes: in the mask the network's answer, elsewhere its neutral one (fact 24)."""
        bundle = self.bundle
        if self.deformer is None:
            return bundle.deform_neutral
        neutral = self._neutral
        if jaw_rot is not None:
            neutral = self._subject.pose(np.zeros(bundle.n_expressions, np.float32), jaw_rot=jaw_rot)
        offsets = bundle.grid.to_map(opencv_from_rig(straight - neutral))
        answer = bundle.grid.from_map(self.deformer(np.ascontiguousarray(offsets)))
        return np.where(self._deformable, answer, bundle.deform_neutral)


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


def _rgba8(rgb: np.ndarray, alpha: np.ndarray, *, straight: bool) -> np.ndarray:
    """float32 [H, W, 3] and [H, W] -> uint8[H, W, 4], rounded."""
    image = np.empty((*alpha.shape, 4), np.uint8)
    if straight:
        rgb = rgb / np.maximum(alpha, 1e-6)[..., None]
    image[..., :3] = np.clip(rgb, 0, 1) * np.float32(255) + np.float32(0.5)
    image[..., 3] = np.clip(alpha, 0, 1) * np.float32(255) + np.float32(0.5) if straight else 255
    return image
