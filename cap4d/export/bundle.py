"""A fitted avatar as the file a player opens: its network in every form, its Gaussians raw, an idle clip, a
picture.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from cap4d.avatar.model import AvatarModel, Pose
from cap4d.bundle.bundle import Bundle
from cap4d.bundle.writer import write_bundle
from cap4d.camera import Camera, head_fixed
from cap4d.capture.capture import Capture
from cap4d.drive.clip import Clip
from cap4d.errors import Cap4dError
from cap4d.export.deformer import export_deformer, worst_difference
from cap4d.export.idle import idle_clip
from cap4d.export.tiers import distance, with_tiers
from cap4d.gaussians import Gaussians
from cap4d.player.deformer import Deformer
from cap4d.player.png import encode_png
from cap4d.render import render
from cap4d.rig.grid import remesh
from cap4d.rig.head import HeadRig

WORST_ONNX_DIFFERENCE = 1e-5  # of the range of the map
COMPARED_FRAMES = 4
PREVIEW_SIZE = 512


def export_bundle(
    model: AvatarModel,
    path: Path,
    *,
    rig: HeadRig,
    capture: Capture,
    clip: Clip | None = None,
    tiers: bool = True,
) -> None:
    """Writes `path`, a `.cap4d` file.

    Args:
        model: The avatar.
        rig: The rig it stands on.
        capture: Its identity is the avatar's, its most frontal camera the default one.
        clip: The capture's parameters as the fit corrected them, for the idle clip; None: as they were
            tracked.
        tiers: Add the deformer's cheaper forms, too, which take most of the time; whoever plays the exact one
            does without.
    Raises:
        Cap4dError: The exported network does not answer as the fitted one does.
    """
    clip = capture.clip() if clip is None else clip
    write_bundle(make_bundle(model, rig=rig, capture=capture, clip=clip, tiers=tiers), path)


def make_bundle(
    model: AvatarModel, *, rig: HeadRig, capture: Capture, clip: Clip, tiers: bool = True
) -> Bundle:
    """The avatar as a player needs it. `clip` is the capture's, corrected or not."""
    camera, idle = default_camera(capture, clip), idle_clip(clip, rig)
    return bundle_of(model, rig=rig, shape=capture.shape, clip=clip, idle=idle, camera=camera, tiers=tiers)


def bundle_of(
    model: AvatarModel,
    *,
    rig: HeadRig,
    shape: np.ndarray,
    clip: Clip,
    idle: Clip,
    camera: Camera,
    tiers: bool = True,
) -> Bundle:
    """The same without a capture.

    Args:
        shape: The identity.
        clip: What its network is compared and made cheaper on, besides `idle`.
        idle: What plays when nothing drives the avatar.
        camera: The default view, in the head-fixed world.
        tiers: See `export_bundle`.
    """
    mesh_subject = rig.subject(shape)
    local = {name: value.detach().numpy() for name, value in model.gaussians.items()}
    bundle = Bundle(
        rig_licence=rig.licence,
        expression_range=np.asarray(rig.expression_range, np.float32),
        grid=model.grid,
        subject=remesh(mesh_subject, model.grid),
        deform_neutral=model.neutral_deformation().numpy(),
        deform_onnx=None if model.deformer is None else checked_onnx(model, clip),
        means=local["means"],
        quats=local["quats"],
        log_scales=local["log_scales"],
        opacity_logits=local["opacity_logits"],
        sh=np.concatenate([local["sh_dc"], local["sh_rest"]], 1),
        binding=model.binding.numpy().astype(np.int32),
        camera=camera,
        idle=idle,
        preview=preview(model, clip, camera),
        mesh_subject=mesh_subject,
    )
    if model.deformer is None or not tiers:
        return bundle
    bundle = with_tiers(bundle, [] if clip is idle else [clip])
    return replace(bundle, tier_errors={"full": float32_error(bundle, model, clip), **bundle.tier_errors})


def checked_onnx(model: AvatarModel, clip: Clip) -> bytes:
    """The network as ONNX, compared with torch on offsets of the clip.

    Raises:
        Cap4dError: They differ by more than 1e-5 of the answers' range.
    """
    data = export_deformer(model.deformer)
    difference = worst_difference(data, model.deformer, sampled_offsets(model, clip))
    if difference > WORST_ONNX_DIFFERENCE:
        raise Cap4dError(
            f"deform.onnx: expected within {WORST_ONNX_DIFFERENCE:g} of torch, found {difference:.2g}"
        )
    return data


def float32_error(bundle: Bundle, model: AvatarModel, clip: Clip) -> tuple[float, float]:
    """(RMS, largest) distance, mm, of the `full` network's answers from torch's in float64, some frames."""
    network, exact = (
        Deformer(bundle.deform_onnx, size=bundle.grid.size),
        copy.deepcopy(model.deformer).double(),
    )
    offsets = sampled_offsets(model, clip)
    with torch.no_grad():
        expected = torch.cat([exact(o[None].double()) for o in offsets]).numpy()
    found = np.stack([network(o.numpy()).copy() for o in offsets])  # its own arrays, used again
    return distance(*(bundle.grid.from_map(maps)[:, bundle.grid.deformable] for maps in (found, expected)))


def sampled_offsets(model: AvatarModel, clip: Clip) -> torch.Tensor:
    """[COMPARED_FRAMES, 3, S, S] m: what the network is given on frames of a clip."""
    frames = np.linspace(0, len(clip) - 1, min(COMPARED_FRAMES, len(clip))).round().astype(int)
    with torch.no_grad():
        return torch.stack([model.offsets(Pose.of(clip.frame(t))) for t in frames])


def default_camera(capture: Capture, clip: Clip) -> Camera:
    """The capture's most frontal camera as it stands to the head on average, in the head-fixed world."""
    rot, tra = np.median(clip.rot, 0), np.median(clip.tra, 0)
    views = [
        Camera(camera.K, head_fixed(camera.viewmat, rot, tra), camera.width, camera.height)
        for camera in capture.cameras.values()
    ]
    return min(views, key=lambda view: view.position[2] / np.linalg.norm(view.position))


def preview(model: AvatarModel, clip: Clip, camera: Camera) -> bytes:
    """PNG of the avatar at the clip's calmest frame, on white."""
    calm = int(np.abs(clip.expr).sum(1).argmin())
    with torch.no_grad():
        posed = model.pose(Pose.of(clip.frame(calm)))
    scale = PREVIEW_SIZE / max(camera.width, camera.height)
    view = camera.resized(round(camera.width * scale), round(camera.height * scale))
    fields = (posed.means, posed.quats, posed.scales, posed.opacities, posed.sh)
    gaussians = Gaussians(*(np.ascontiguousarray(f.numpy()) for f in fields))
    rgb = render(gaussians, view).rgb
    return encode_png((np.clip(rgb, 0, 1) * 255).round().astype(np.uint8))
