"""The network in 8-bit integers: the same bits on every instruction set, and near its float32 original."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import tolerances as tol
import torch
from tiny_bundle import tiny_grid, tiny_mesh

from cap4d import _core
from cap4d.avatar.deformer import Deformer
from cap4d.camera import opencv_from_rig
from cap4d.export.deformer import export_deformer
from cap4d.export.quantize import quantize

SIZE = 64
SHAPES = [(8, 4), (32, 24), (64, 16), (128, 64)]
TESTS = Path(__file__).resolve().parents[1]
CHILD = """
import sys
sys.path.insert(0, sys.argv[2])
import numpy as np
from cap4d import _core
from quantized_reference import random_network
out = {"isa": _core.QuantizedUnet.isa}
for size, width in eval(sys.argv[3]):
    offsets = np.random.default_rng(size).normal(0, 0.01, (3, size, size)).astype(np.float32)
    out[f"{size}_{width}"] = _core.QuantizedUnet(random_network(size, width), size).run(offsets)
np.savez(sys.argv[1], **out)
"""


def results_of(isa: str, folder: Path) -> dict[str, np.ndarray]:
    """Answers of SHAPES's networks by one instruction set; "isa" is the one that did run."""
    path = folder / f"{isa}.npz"
    command = [sys.executable, "-c", CHILD, str(path), str(TESTS), repr(SHAPES)]
    subprocess.run(command, env=os.environ | {"CAP4D_ISA": isa}, check=True)
    with np.load(path) as results:
        return dict(results)


@pytest.fixture(scope="module")
def base_results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    return results_of("base", tmp_path_factory.mktemp("isa"))


@pytest.mark.parametrize("isa", ["v3", "v4", "vnni"])
def test_instruction_sets_give_the_same_bits(
    isa: str, base_results: dict[str, np.ndarray], tmp_path: Path
) -> None:
    results = results_of(isa, tmp_path)
    assert base_results["isa"] == "base"
    if isa != "vnni" and results["isa"] != isa:  # vnni asks for the widest there is
        pytest.skip(f"this processor does not run {isa}, but {results['isa']}")
    for size, width in SHAPES:
        key = f"{size}_{width}"
        assert base_results[key].std() > 1e-4
        np.testing.assert_array_equal(results[key], base_results[key], err_msg=key)


def expressions(count: int, *, seed: int = 0) -> np.ndarray:
    """float32[count, 3, S, S] m: offsets of a rig."""
    grid, rng = tiny_grid(SIZE), np.random.default_rng(seed)
    subject = tiny_mesh(SIZE).resample(grid.vertices, grid.bary)
    neutral = subject.pose(np.zeros(5, np.float32))
    posed = [subject.pose(expr) for expr in rng.uniform(0, 1, (count, 5)).astype(np.float32)]
    return np.ascontiguousarray(np.stack([grid.to_map(opencv_from_rig(p - neutral)) for p in posed]))


def speaking_network(width: int) -> Deformer:
    """A network with an answer: random weights, the last layer's scaled to an answer of 1 mm RMS."""
    mask = tiny_grid(SIZE).to_map(np.ones((len(tiny_grid(SIZE)), 1), bool))[0]
    net = Deformer(mask, width=width, generator=torch.Generator().manual_seed(width))
    last = net.model.model[-1]
    with torch.no_grad():
        torch.nn.init.normal_(last.weight, generator=torch.Generator().manual_seed(1))
        answer = net(torch.from_numpy(expressions(8)))
        last.weight *= 1e-3 / answer.std()
    return net


@pytest.mark.parametrize("width", [5, 16, 64])
def test_answers_are_near_those_of_onnxruntime(width: int) -> None:
    model = export_deformer(speaking_network(width))
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    unet = _core.QuantizedUnet(quantize(model, expressions(24)), SIZE)
    asked = expressions(8, seed=1)  # not those that it was calibrated on
    expected = np.concatenate([session.run(None, {"offsets": x[None]})[0] for x in asked])
    error = 1e3 * np.linalg.norm(np.stack([unet.run(x) for x in asked]) - expected, axis=1)
    moves = 1e3 * np.linalg.norm(expected - expected.mean(0), axis=1)
    rms, most = float(np.sqrt((error**2).mean())), float(error.max())
    print(f"width {width}: {rms:.4f} mm RMS, {most:.4f} mm at most, of {np.sqrt((moves**2).mean()):.2f} mm")
    assert np.sqrt((moves**2).mean()) > 0.1
    assert rms < tol.INT8_RMS_MM
    assert most < tol.INT8_MOST_MM


def test_the_first_layer_is_folded_exactly() -> None:
    from quantized_reference import first

    net = speaking_network(16)
    tensors = quantize(export_deformer(net), expressions(2))
    offsets = expressions(1, seed=3)
    with torch.no_grad():
        x = torch.from_numpy(offsets) * (net.mask / 0.0108)
        expected = net.model.model[0](torch.cat([x, net.encoding[None]], 1))[0].permute(1, 2, 0).numpy()
    found = first(tensors, offsets[0])
    assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()
