"""The network in float32 on every instruction set, against torch in float64."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tolerances as tol
import torch

from cap4d.avatar.deformer import Deformer
from cap4d.bundle.float_unet import float_unet
from cap4d.export.deformer import export_deformer

SHAPES = [(8, 4), (32, 24), (64, 16), (128, 16), (128, 64)]
CHILD = """
import sys
import numpy as np
from cap4d import _core
with np.load(sys.argv[1]) as file:
    tensors = dict(file)
offsets = tensors.pop("offsets")
unet = _core.FloatUnet(tensors, offsets.shape[-1])
np.savez(sys.argv[2], isa=unet.isa, one=unet.run(offsets, 1), two=unet.run(offsets, 2))
"""


def speaking_network(size: int, width: int) -> Deformer:
    """Random weights that answer."""
    generator = torch.Generator().manual_seed(width)
    net = Deformer(np.ones((size, size), bool), width=width, generator=generator)
    torch.nn.init.normal_(net.model.model[-1].weight, std=0.02, generator=generator)
    return net


def true_answer(net: Deformer, offsets: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return net.double()(torch.from_numpy(offsets[None]).double())[0].numpy()


def answer_of(isa: str, net: Deformer, offsets: np.ndarray, folder: Path) -> dict[str, np.ndarray]:
    asked, told = folder / "asked.npz", folder / "told.npz"
    np.savez(asked, offsets=offsets, **float_unet(export_deformer(net), offsets.shape[-1]))
    command = [sys.executable, "-c", CHILD, str(asked), str(told)]
    subprocess.run(command, env=os.environ | {"CAP4D_ISA": isa}, check=True)
    with np.load(told) as results:
        return dict(results)


@pytest.mark.parametrize("isa", ["base", "v3", "v4"])
@pytest.mark.parametrize(("size", "width"), SHAPES)
def test_answers_are_those_of_float64(isa: str, size: int, width: int, tmp_path: Path) -> None:
    net = speaking_network(size, width)
    offsets = np.random.default_rng(size).normal(0, 0.01, (3, size, size)).astype(np.float32)
    found = answer_of(isa, net, offsets, tmp_path)
    if found["isa"] != isa:
        pytest.skip(f"this processor does not run {isa}, but {found['isa']}")
    expected = true_answer(net, offsets)
    error = np.abs(found["one"] - expected).max() / np.ptp(expected)
    print(f"{isa} {size} px, width {width}: {error:.1e} of the range")
    assert error < tol.FLOAT_UNET
    np.testing.assert_array_equal(found["one"], found["two"])
