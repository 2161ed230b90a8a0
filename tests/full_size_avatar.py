"""A full-size avatar of the stand-in FLAME for benches: the released system's sizes, without its training.

    python tests/full_size_avatar.py FLAME.npz DATA OUT.cap4d

Rig: `cap4d rig import flame` of flame/flame_standin.pkl. Gaussians: 102,925, as fact 29 places them, SH
degree 3, fitted to the one photo photos/tesla for 200 steps, without growth. Network: the released U-Net, 64
wide at 128 x 128, trained to answer a made-up displacement (`made_up_displacement`): some millimetres, smooth
on the head, a nonlinear function of the expression. Idle clip: the first 8 s of flame/sequence_00. It says
nothing about how such an avatar looks; its sizes, its costs and the smoothness of its network count.
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from cap4d.avatar.deformer import DEFORM_STD, Deformer
from cap4d.avatar.fit import prepare, run
from cap4d.avatar.model import AvatarModel, Pose
from cap4d.avatar.presets import PRESETS, Densify
from cap4d.avatar.views import load_views, split_views
from cap4d.capture.capture import Capture
from cap4d.drive.clip import Clip
from cap4d.export.bundle import export_bundle
from cap4d.rig.store import load_rig

log = logging.getLogger(__name__)

WIDTH = 64
PRESET = replace(
    PRESETS["debug"],
    name="full size",
    iterations=200,
    gaussians=100_000,
    per_face=2,
    sh_degree=3,
    sh_every=40,
    densify=Densify(start=1, stop=0, every=1),
)
MODES = 6
MODE_SIZE = 1.5e-3  # m, root mean square of each mode
STEPS, BATCH = 400, 2
RATES = (5e-4, 5e-5)


def make_full_size_avatar(rig_path: Path, data: Path, output: Path, *, steps: int = STEPS) -> None:
    """Writes `output`; some minutes on two cores."""
    rig, capture = load_rig(rig_path), Capture.load(data / "photos/tesla")
    split = split_views([capture], load_views([capture], PRESET.image_size))
    trainer = prepare([capture], split, rig, PRESET, ablate="unet", seed=0)
    run(trainer, lambda: None)
    model, clip = trainer.model, performance(capture, data / "flame/sequence_00/fit.npz")
    model.deformer = trained_network(model, clip, steps=steps)
    export_bundle(model, output, rig=rig, capture=capture, clip=clip)


def performance(capture: Capture, sequence: Path) -> Clip:
    """The sequence's expressions and gaze, with the head held where the photo has it."""
    still = capture.clip()
    with np.load(sequence, allow_pickle=False) as arrays:
        expr, eye_rot, fps = arrays["expr"], arrays["eye_rot"], float(arrays["fps"])
    zeros = np.zeros_like(eye_rot)
    held = {name: np.repeat(getattr(still, name)[:1], len(expr), 0) for name in ("rot", "tra")}
    return Clip(still.rig_name, fps, expr, eye_rot, neck_rot=zeros, jaw_rot=zeros, **held)


def made_up_displacement(model: AvatarModel, *, seed: int = 0):
    """A function from expressions [B, E] to [B, G, 3] m: 0.5 mm at rest and six modes of 1.5 mm each,
    waves of 5 to 15 cm on the neutral head, driven by tanh of random directions of the expression.
    """
    rng = np.random.default_rng(seed)
    points = model.subject.neutral.numpy().astype(np.float64)
    waves = rng.normal(size=(MODES + 1, 3, 3))
    lengths = rng.uniform(0.05, 0.15, (MODES + 1, 3, 1))
    waves *= 2 * np.pi / lengths / np.linalg.norm(waves, axis=2, keepdims=True)
    phases = rng.uniform(0, 2 * np.pi, (MODES + 1, 3))
    fields = np.sqrt(2) * np.sin(np.einsum("gc,kdc->kgd", points, waves) + phases[:, None])
    fields = torch.from_numpy((MODE_SIZE / np.sqrt(3) * fields).astype(np.float32))
    directions = rng.normal(size=(model.subject.expression_basis.shape[0], MODES)) / np.sqrt(len(waves) * 10)
    directions = torch.from_numpy(directions.astype(np.float32))

    def displacement(expr: torch.Tensor) -> torch.Tensor:
        drive = torch.tanh(expr @ directions)
        return fields[-1] / 3 + torch.einsum("bk,kgd->bgd", drive, fields[:-1])

    return displacement


def trained_network(model: AvatarModel, clip: Clip, *, steps: int, seed: int = 0) -> Deformer:
    """The network after `steps` of Adam on jittered frames of the clip; every other batch has one at rest."""
    generator = torch.Generator().manual_seed(seed)
    valid = np.zeros((model.grid.size, model.grid.size), bool)
    valid[model.grid.pixels[:, 0], model.grid.pixels[:, 1]] = True
    net = Deformer(valid, width=WIDTH, generator=generator)
    target = made_up_displacement(model, seed=seed)
    optimizer = torch.optim.Adam(net.parameters(), lr=RATES[0], fused=True)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, (RATES[1] / RATES[0]) ** (1 / steps))
    rng, begun = np.random.default_rng(seed), time.monotonic()
    for step in range(steps):
        poses = [Pose.of(clip.frame(int(rng.integers(len(clip))))) for _ in range(BATCH)]
        jitter = 0.3 * torch.randn(BATCH, len(poses[0].expr), generator=generator)
        poses = [replace(p, expr=p.expr + j) for p, j in zip(poses, jitter, strict=True)]
        if step % 2:
            poses[0] = replace(poses[0], expr=torch.zeros_like(poses[0].expr), eye_rot=torch.zeros(3))
        answer = model.grid.from_map(net(torch.stack([model.offsets(p) for p in poses])))
        loss = ((answer - target(torch.stack([p.expr for p in poses]))) / DEFORM_STD).square().mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 20 == 19 or step == 0:
            error = 1e3 * DEFORM_STD * loss.item() ** 0.5
            log.info("step %d: %.2f mm from the target, %.0f s", step, error, time.monotonic() - begun)
    return net


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Writes a full-size avatar of the stand-in FLAME.")
    parser.add_argument("rig", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--steps", type=int, default=STEPS)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    words = parser.parse_args()
    make_full_size_avatar(words.rig, words.data, words.output, steps=words.steps)
