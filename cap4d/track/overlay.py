"""Pictures of how well the rig lies on the person: its shaded mesh over each frame, and the landmarks."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from cap4d.camera import Camera, opencv_from_rig
from cap4d.capture.capture import Capture, View
from cap4d.mesh import shade
from cap4d.rig.head import HeadRig

OPACITY = 0.55
MAX_SIDE = 720  # px


def draw_overlay(
    capture: Capture, rig: HeadRig, view: View, landmarks: np.ndarray | None = None
) -> np.ndarray:
    """uint8[H, W, 3]: the photo left, the rig drawn over it right; landmarks [P, 2] px as dots."""
    camera = capture.head_camera(view)
    scale = min(1.0, MAX_SIDE / max(camera.width, camera.height))
    camera = camera.resized(_even(camera.width * scale), _even(camera.height * scale))
    photo = cv2.resize(capture.image(view), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    drawn = _blend(photo, _posed(capture, rig, view.frame), rig, camera)
    pair = np.uint8(np.concatenate([photo, drawn], 1) * 255)
    for x, y in [] if landmarks is None else landmarks * scale:
        cv2.circle(
            pair, (round((x - 0.5) * 16), round((y - 0.5) * 16)), 12, (40, 255, 80), -1, cv2.LINE_AA, 4
        )
    return pair


def write_video(path: Path, frames, fps: float) -> None:
    """H.264 of uint8[H, W, 3] frames of one even size."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "20"}
        for i, frame in enumerate(frames):
            if i == 0:
                stream.height, stream.width = frame.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def _posed(capture: Capture, rig: HeadRig, frame: int) -> np.ndarray:
    subject = rig.subject(capture.shape)
    poses = {name: getattr(capture, name)[frame] for name in ("eye_rot", "neck_rot", "jaw_rot")}
    return opencv_from_rig(np.asarray(subject.pose(capture.expr[frame], **poses), np.float64))


def _blend(photo: np.ndarray, vertices: np.ndarray, rig: HeadRig, camera: Camera) -> np.ndarray:
    rgba = shade(vertices, rig.faces, camera, colors=rig.colors, supersample=1)
    cover = OPACITY * rgba[..., 3:]
    return photo * (1 - cover) + rgba[..., :3] * cover


def _even(x: float) -> int:
    return max(2, 2 * round(x / 2))
