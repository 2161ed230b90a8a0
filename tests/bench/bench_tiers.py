"""The `full` tier beside plain onnxruntime on torch's own export of the same network, two threads.

    python -m pytest -m bench -s tests/bench/bench_tiers.py

Calls take turns, so that what else the machine does hits all alike; but for plain onnxruntime with its
threads spinning, its default, which would take a core from whatever comes after it: that runs alone.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable

import numpy as np
import onnxruntime
import pytest
import torch

from cap4d.avatar.deformer import DEFORM_STD
from cap4d.avatar.deformer import Deformer as TorchDeformer
from cap4d.bundle.onnx_half import halve_weights
from cap4d.export.deformer import export_deformer
from cap4d.player.deformer import Deformer

pytestmark = pytest.mark.bench
SIZE, THREADS, ROUNDS = 128, 2, 40
Call = Callable[[np.ndarray], np.ndarray]


def exported_by_torch(net: TorchDeformer) -> bytes:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        names = dict(input_names=["offsets"], output_names=["deformation"])
        return torch.onnx.export(net, (torch.zeros(1, 3, SIZE, SIZE),), dynamo=True, **names).model_proto


def plain(model: bytes, *, spinning: bool) -> Call:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = THREADS
    options.add_session_config_entry("session.intra_op.allow_spinning", str(int(spinning)))
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    return lambda offsets: session.run(["deformation"], {"offsets": offsets[None]})[0][0]


def timed(calls: dict[str, Call], maps: np.ndarray) -> dict[str, list[float]]:
    """Milliseconds of each call, in turns; the first two rounds warm up."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for i in range(ROUNDS + 2):
        for name, call in calls.items():
            start = time.perf_counter()
            call(maps[i % len(maps)])
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: values[2:] for name, values in times.items()}


@pytest.mark.parametrize("width", [64, 16])
def test_full_is_no_slower_than_plain_onnxruntime(width: int) -> None:
    generator = torch.Generator().manual_seed(0)
    net = TorchDeformer(np.ones((SIZE, SIZE), bool), width=width, generator=generator).eval()
    torch.nn.init.normal_(net.model.model[-1].weight, std=0.02, generator=generator)
    torch_model, ours = exported_by_torch(net).SerializeToString(), export_deformer(net)
    calls = {
        "onnxruntime": plain(torch_model, spinning=False),
        "full": Deformer(ours, size=SIZE, threads=THREADS),
        "fp16": Deformer(halve_weights(ours), size=SIZE, threads=THREADS),
        "full, one thread": Deformer(ours, size=SIZE, threads=1),
    }
    maps = (DEFORM_STD * np.random.default_rng(0).normal(size=(4, 3, SIZE, SIZE))).astype(np.float32)
    times = timed(calls, maps)
    times |= timed({"onnxruntime, spinning": plain(torch_model, spinning=True)}, maps)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    print(f"\nwidth {width}")
    for name, values in times.items():
        print(f"{name:>22}: median {medians[name]:6.2f} ms, 95 % {np.percentile(values, 95):6.2f}")
    expected = calls["onnxruntime"](maps[0])
    span = float(np.ptp(expected))
    print(f"differ by {np.abs(calls['full'](maps[0]) - expected).max() / span:.1e} of the range", end="")
    print(f", fp16 by {np.abs(calls['fp16'](maps[0]) - expected).max() / span:.1e}")
    assert np.abs(calls["full"](maps[0]) - expected).max() < 1e-5 * span
    assert medians["full"] <= min(medians["onnxruntime"], medians["onnxruntime, spinning"])
