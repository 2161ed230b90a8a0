"""How long the deformation network takes as onnxruntime runs the exported graph, and in 8-bit integers, and
how far apart the answers are.

    python -m pytest -m bench -s tests/bench/bench_deformer.py
    CAP4D_BENCH_AVATARS=me.cap4d:you.cap4d python -m pytest -m bench -s tests/bench/bench_deformer.py

Two threads; variants take turns with a few frames each, so that what else the machine does hits all alike.
The first frame of a turn warms the caches and is not counted. Before each turn the threads of onnxruntime's
spinning variant get the time to fall asleep; else they take a core from whoever comes next. The networks are
those of the avatars named in the environment, asked for the frames of their idle clips, and without any,
networks of the released size and of a quarter of its width, trained for a moment to a smooth answer of their
own. Half of the frames calibrate, errors are those of the other half.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from cap4d import _core
from cap4d.avatar.deformer import DEFORM_STD, Deformer
from cap4d.bundle import read_bundle
from cap4d.camera import opencv_from_rig
from cap4d.export.deformer import export_deformer
from cap4d.export.quantize import quantize
from cap4d.rig.builtin import build_head
from cap4d.rig.grid import UvGrid, build_grid, remesh
from cap4d.rig.head import Subject
from cap4d.synth.idle import idle_clip

pytestmark = pytest.mark.bench
THREADS, ROUNDS, TURN, FRAMES = 2, 12, 5, 48
PAUSE = 0.05  # s
RMS_MM, MOST_MM = 0.02, 0.2  # of vertices that may move
WANTED_RATIO = 2.5  # of onnxruntime's median to ours
Call = Callable[[np.ndarray], np.ndarray]


def expression_maps(subject: Subject, grid: UvGrid, expr: np.ndarray, eye_rot: np.ndarray) -> np.ndarray:
    """float32[FRAMES, 3, S, S] m: what the network is asked over a clip."""
    frames = np.linspace(0, len(expr) - 1, FRAMES).round().astype(int)
    neutral = subject.pose(np.zeros(expr.shape[1], np.float32))
    posed = [subject.pose(expr[t], eye_rot=eye_rot[t]) for t in frames]
    return np.ascontiguousarray(np.stack([grid.to_map(opencv_from_rig(p - neutral)) for p in posed]))


def stored(path: Path) -> tuple[bytes, np.ndarray, np.ndarray]:
    """An avatar's network, the maps it is asked, and its grid pixels that may move."""
    bundle = read_bundle(path)
    if bundle.deform_onnx is None:
        pytest.skip(f"{path}: no network")
    subject = bundle.subject.map(np.ascontiguousarray)
    maps = expression_maps(subject, bundle.grid, bundle.idle.expr, bundle.idle.eye_rot)
    return bundle.deform_onnx, maps, moving(bundle.grid)


def trained(width: int, *, steps: int = 60) -> tuple[bytes, np.ndarray, np.ndarray]:
    """The same of a network on the built-in head that has learnt to answer with its offsets, swirled."""
    rig = build_head()
    grid = build_grid(rig)
    clip = idle_clip(rig)
    maps = expression_maps(remesh(rig.subject(), grid), grid, clip.expr, clip.eye_rot)
    net = Deformer(grid.to_map(np.ones((len(grid), 1), bool))[0], width=width)
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-3)
    offsets = torch.from_numpy(maps)
    targets = 0.4 * offsets.roll(1, 1) + 0.02 * DEFORM_STD * net.encoding[None, [0, 14, 7]]
    rng = np.random.default_rng(0)
    for _ in range(steps):
        chosen = rng.choice(FRAMES, 2, replace=False)
        loss = ((net(offsets[chosen]) - targets[chosen]) / DEFORM_STD).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return export_deformer(net), maps, moving(grid)


def moving(grid: UvGrid) -> np.ndarray:
    """bool[S, S]"""
    return grid.to_map(grid.deformable[:, None])[0]


def onnx_call(model: bytes, *, spinning: bool) -> Call:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = THREADS
    if not spinning:
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    return lambda offsets: session.run(None, {"offsets": offsets[None]})[0][0]


def products(tensors: dict[str, np.ndarray], size: int) -> int:
    """Multiplications of integers in a frame."""
    total = 0
    for name, value in tensors.items():
        if value.dtype == np.int8:
            layer = int(name[name.index(".") - 1])
            pixels = (size >> layer + 1) ** 2  # of a down's output, of an up's input
            total += pixels * value.size
    return total


def cases() -> list:
    named = [Path(p) for p in os.environ.get("CAP4D_BENCH_AVATARS", "").split(":") if p]
    if named:
        return [pytest.param(lambda path=path: stored(path), id=path.stem) for path in named]
    return [pytest.param(lambda width=width: trained(width), id=f"width {width}") for width in (64, 16)]


@pytest.mark.parametrize("case", cases())
def test_deformer(case: Callable[[], tuple[bytes, np.ndarray, np.ndarray]]) -> None:
    model, maps, moves = case()
    size = maps.shape[-1]
    tensors = quantize(model, maps[::2])
    unet = _core.QuantizedUnet(tensors, size)
    calls: dict[str, Call] = {
        "onnxruntime float32, spinning": onnx_call(model, spinning=True),
        "onnxruntime float32": onnx_call(model, spinning=False),
        f"int8 ({unet.isa})": lambda offsets: unet.run(offsets, THREADS),
        "int8, one thread": lambda offsets: unet.run(offsets, 1),
    }
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(ROUNDS):
        for name, call in calls.items():
            time.sleep(PAUSE)
            for i in range(TURN):
                start = time.perf_counter()
                call(maps[(TURN * turn + i) % FRAMES])
                if i > 0:
                    times[name].append(time.perf_counter() - start)
    float32 = calls["onnxruntime float32"]
    expected = np.stack([float32(m) for m in maps[1::2]])
    found = np.stack([unet.run(m, THREADS) for m in maps[1::2]])
    error = 1e3 * np.linalg.norm(found - expected, axis=1)[:, moves]
    motion = 1e3 * np.linalg.norm(expected - expected.mean(0), axis=1)[:, moves]
    rms = lambda x: float(np.sqrt(np.square(x).mean()))  # noqa: E731
    print(f"\n{len(tensors['down0.weight'])} wide, {products(tensors, size) / 1e9:.3f} G integer products")
    medians = {}
    for name, values in times.items():
        ms = 1e3 * np.array(values)
        medians[name] = float(np.median(ms))
        print(f"{name:>30}: median {medians[name]:7.3f} ms, 95 % {np.percentile(ms, 95):7.3f}", end="")
        print(f", {medians['onnxruntime float32, spinning'] / medians[name]:5.2f} x")
    print(f"vertex error {rms(error):.4f} mm RMS, {error.max():.4f} mm at most", end="")
    print(f"; the answer moves by {rms(motion):.3f} mm RMS, {motion.max():.3f} mm at most")
    plain = min(medians["onnxruntime float32, spinning"], medians["onnxruntime float32"])
    assert plain / medians[f"int8 ({unet.isa})"] >= WANTED_RATIO
    assert rms(error) < RMS_MM
    assert error.max() < MOST_MM
