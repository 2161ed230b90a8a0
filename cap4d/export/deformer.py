"""The deformation network as a self-contained ONNX file, and how far that is from torch."""

from __future__ import annotations

import numpy as np
import onnxruntime
import torch

from cap4d.avatar.deformer import DEFORM_STD, ENCODING_CHANNELS, Deformer
from cap4d.export.unet_onnx import unet_onnx


def export_deformer(deformer: Deformer) -> bytes:
    """The network as a serialised ONNX model; see `unet_onnx`."""
    weights = {name: value.detach().numpy() for name, value in deformer.named_parameters()}
    half = ENCODING_CHANNELS // 2
    encoding = deformer.encoding.numpy()[None]
    # Only one row and one column of the encoding is stored: the whole would weigh 1.5 MB.
    constants = {
        "scale": deformer.mask.numpy()[None, None] / np.float32(DEFORM_STD),
        "rows": encoding[:, :half, :, :1],
        "columns": encoding[:, half:, :1, :],
        "metres": np.array(DEFORM_STD, np.float32),
    }
    return unet_onnx(weights | constants)


def worst_difference(onnx_model: bytes, deformer: Deformer, offsets: torch.Tensor) -> float:
    """Largest difference between onnxruntime and torch on maps [B, 3, S, S] m, relative to the range of
    torch's answers.

    Zero where the network answers nothing but zeros, as it does before its first step.
    """
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(onnx_model, options, providers=["CPUExecutionProvider"])
    with torch.no_grad():
        expected = torch.cat([deformer(o[None]) for o in offsets]).numpy()
    found = np.concatenate([session.run(None, {"offsets": o[None].numpy()})[0] for o in offsets])
    span = float(expected.max() - expected.min())
    error = float(np.abs(found - expected).max())
    return error / span if span > 0 else error
