"""A room with many cameras: captures of people who do not exist, whose truth is known to the last number.

As `synthesize` without an identity, but with painted skin in soft light. The folder appears when it is whole.
"""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path

import numpy as np

from cap4d.camera import Camera, head_fixed, look_at, opencv_from_rig
from cap4d.capture.folder import check_new_folder, new_folder
from cap4d.capture.image import write_image
from cap4d.rig.head import HeadRig
from cap4d.synth.body import draw_body
from cap4d.synth.capture import Performance, perform, save_performance
from cap4d.synth.portrait import Person, Pose, draw_person, picture, pose_person
from cap4d.track.progress import progress

log = logging.getLogger(__name__)

DISTANCE, FOV_DEG = 1.1, 19.0  # m and degrees of every camera
TARGET = np.array([0.0, -0.002, 0.006])  # m, head-fixed, OpenCV axes: what the cameras look at
YAW_DEG, PITCH_DEG = 64.0, (-17.0, 2.0, 20.0)  # outermost cameras, and the rows they stand in
TEXELS_PER_PIXEL, TEXELS = 4, (256, 2048)  # of the texture: a side per side of the image, and its limits
PERSON = "person.json"


def film(
    rig: HeadRig,
    output: Path,
    *,
    identity: int,
    views: int = 16,
    frames: int = 100,
    size: int = 512,
    seed: int = 0,
    deviations: float = 1.0,
) -> None:
    """Writes a capture of person number `identity`.

    Args:
        rig: Any rig with UVs.
        output: A new folder.
        views: Cameras around the front of the head, the same for every identity.
        frames: The first one is at rest.
        size: Pixels a side.
        seed: Of cameras and performance.
        deviations: How far the person moves otherwise than the rig's model (see body.py); 0 is not at all.
    Raises:
        ArgumentError: A number out of range, no UVs, or no new folder can be made there.
    """
    check_new_folder(Path(output))
    person = draw_person(rig, identity, texels=int(np.clip(TEXELS_PER_PIXEL * size, *TEXELS)))
    body = draw_body(rig, person.subject, np.random.default_rng([identity, 3]), deviations)
    cameras = ring_of_cameras(views, size, np.random.default_rng(seed))
    performance = perform(rig, frames, np.random.default_rng([seed, identity]))
    valid = np.ones((views, frames), bool)
    start = time.monotonic()
    with new_folder(Path(output)) as folder:
        save_performance(rig, folder, person.shape, cameras, performance, valid)
        _write_person(folder, rig, identity, seed, deviations)
        for t in progress(range(frames), f"{output}: frames of {views} views", frames):
            expr, turns = (
                performance.expr[t],
                {n: getattr(performance, n)[t] for n in ("eye_rot", "neck_rot")},
            )
            vertices = opencv_from_rig(body.pose(expr, **turns).astype(np.float64))
            _shoot(folder, person, pose_person(person, vertices), cameras, performance, t)
    log.info("%s: %d images in %.0f s", output, views * frames, time.monotonic() - start)


def ring_of_cameras(views: int, size: int, rng: np.random.Generator) -> dict[str, Camera]:
    """Cameras in three rows about the front of the head; the middle one looks it in the face."""
    yaw = np.linspace(-YAW_DEG, YAW_DEG, views) if views > 1 else np.zeros(1)
    rows = np.array(PITCH_DEG)[np.arange(views) * 2 % 3]
    yaw, pitch = yaw + rng.uniform(-1.5, 1.5, views), rows + rng.uniform(-3, 3, views)
    middle = np.argmin(np.abs(yaw))
    yaw[middle], pitch[middle] = 0, 0
    focal = 0.5 * size / np.tan(np.radians(FOV_DEG) / 2)
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    cameras = {}
    for i, (y, p) in enumerate(np.radians(np.stack([yaw, pitch], 1))):
        away = np.array([np.sin(y) * np.cos(p), -np.sin(p), -np.cos(y) * np.cos(p)])
        cameras[f"cam{i:02d}"] = Camera(K, look_at(TARGET + DISTANCE * away, TARGET), size, size)
    return cameras


def _shoot(
    folder: Path, person: Person, pose: Pose, cameras: dict[str, Camera], performance: Performance, t: int
) -> None:
    for name, camera in cameras.items():
        fixed = head_fixed(camera.viewmat, performance.rot[t], performance.tra[t])
        rgb, matte = picture(person, pose, Camera(camera.K, fixed, camera.width, camera.height))
        write_image(folder / "images" / name / f"{t:05d}.png", rgb)
        write_image(folder / "bg" / name / f"{t:04d}.png", matte)


def _write_person(folder: Path, rig: HeadRig, identity: int, seed: int, deviations: float) -> None:
    facts = {"rig": rig.name, "identity": identity, "seed": seed, "deviations": deviations}
    (folder / PERSON).write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
