"""The quantised deformation U-Net spelled out in NumPy, and random networks for it.

Convolutions are one matrix product per tap, of integers held in float64, which is exact. What the C++ does in
float32 is done here in the same order, so that answers can be compared bit by bit.
"""

from __future__ import annotations

import numpy as np

from cap4d.bundle.quantized_unet import channels, depth, quantized_specs

F = np.float32
LEAK, NORM_EPS = F(0.2), F(1e-5)


def random_network(size: int, width: int, *, seed: int = 0) -> dict[str, np.ndarray]:
    """Tensors whose activations fill their range and whose answer is some millimetres."""
    rng = np.random.default_rng(seed)
    tensors = {}
    for name, spec in quantized_specs(size, width).items():
        draw = rng.normal(size=spec.shape)
        kind = name.split(".")[-1]
        if name == "mask":
            value = rng.uniform(size=spec.shape) < 0.8
        elif spec.dtype is np.int8:
            value = rng.integers(-127, 128, spec.shape)
        elif kind == "leaky_zero":
            value = rng.integers(20, 90, spec.shape)
        elif kind in ("leaky_scale", "relu_scale"):
            value = 0.01 + 0.01 * rng.uniform(size=spec.shape)
        elif kind == "scale":
            inputs = quantized_specs(size, width)[name.replace("scale", "weight")].shape
            value = (1 + rng.uniform(size=spec.shape)) / (9000 * np.sqrt(16 * max(inputs[:2])))
            value = value * (1e-3 if name == "up0.scale" else 1)
        elif name == "down0.weight":
            value = 20 * draw
        else:
            value = 0.3 * draw * (1e-3 if name == "up0.bias" else 1)
        tensors[name] = np.ascontiguousarray(value, spec.dtype)
    return tensors


def reference(tensors: dict[str, np.ndarray], offsets: np.ndarray) -> np.ndarray:
    """float32[3, S, S] m -> float32[3, S, S] m."""
    t, size = tensors, offsets.shape[1]
    width, layers = len(t["down0.weight"]), depth(size)
    leaky, relu = {}, {}
    x = first(t, offsets)
    for i in range(layers):
        if i > 0:
            sums = conv(leaky[i - 1].astype(np.float64) - t[f"down{i - 1}.leaky_zero"], t[f"down{i}.weight"])
            flat = sums.reshape(-1, channels(width, i))
            mean, gain = norm(flat, t[f"down{i}.scale"])
            if i == layers - 1:
                mean, gain = -t[f"down{i}.bias"] / t[f"down{i}.scale"], t[f"down{i}.scale"]
            x = (sums.astype(F) - mean) * gain
        if i < layers - 1:
            scale, zero = t[f"down{i}.leaky_scale"], t[f"down{i}.leaky_zero"]
            leaky[i] = to_bytes(np.maximum(x, x * LEAK), scale, zero)
        relu[i] = to_bytes(np.maximum(x, F(0)), t[f"down{i}.relu_scale"])
    below = None
    for i in reversed(range(layers)):
        inputs = relu[i] if below is None else np.concatenate([relu[i], below], -1)
        sums = conv_transposed(inputs.astype(np.float64), t[f"up{i}.weight"])
        if i == 0:
            break
        # Sums are added up one parity after the other.
        flat = np.concatenate([sums[p::2, q::2].reshape(-1, sums.shape[-1]) for p in (0, 1) for q in (0, 1)])
        mean, gain = norm(flat, t[f"up{i}.scale"])
        below = to_bytes(np.maximum((sums.astype(F) - mean) * gain, F(0)), t[f"up{i}.relu_scale"])
    return np.moveaxis(sums.astype(F) * t["up0.scale"] + t["up0.bias"], -1, 0)


def first(t: dict[str, np.ndarray], offsets: np.ndarray) -> np.ndarray:
    """Down 0 in float32: [S/2, S/2, width]."""
    half = offsets.shape[1] // 2
    edge = np.ones(half, int)
    edge[0], edge[-1] = 0, 2
    x = t["down0.rows"][edge].swapaxes(0, 1) + t["down0.columns"][edge]
    masked = np.pad(np.where(t["mask"], offsets, F(0)), ((0, 0), (1, 1), (1, 1)))
    for ky in range(4):
        for axis in range(3):
            for kx in range(4):
                tap = masked[axis, ky : ky + 2 * half : 2, kx : kx + 2 * half : 2]
                x = x + tap[..., None] * t["down0.weight"][:, axis, ky, kx]
    return x


def conv(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """4 x 4, stride 2, a border of zeros: [H, W, I] and [O, I, 4, 4] -> [H/2, W/2, O]."""
    h, w, _ = x.shape
    padded = np.pad(x, ((1, 1), (1, 1), (0, 0)))
    out = np.zeros((h // 2, w // 2, len(weight)))
    for ky in range(4):
        for kx in range(4):
            out += padded[ky : ky + h : 2, kx : kx + w : 2] @ weight[:, :, ky, kx].T.astype(np.float64)
    return out


def conv_transposed(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Its transpose: [H, W, I] and [I, O, 4, 4] -> [2H, 2W, O]."""
    h, w, _ = x.shape
    out = np.zeros((2 * h + 2, 2 * w + 2, weight.shape[1]))
    for ky in range(4):
        for kx in range(4):
            out[ky : ky + 2 * h : 2, kx : kx + 2 * w : 2] += x @ weight[:, :, ky, kx].astype(np.float64)
    return out[1:-1, 1:-1]


def norm(sums: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """InstanceNorm of sums [n, C]: what to subtract and what to multiply with."""
    share = F(1) / F(len(sums))
    x = sums.astype(F)
    mean = np.cumsum(x, 0, dtype=F)[-1] * share
    variance = np.cumsum((x - mean) ** 2, 0, dtype=F)[-1] * share
    return mean, F(1) / np.sqrt(variance + NORM_EPS / (scale * scale))


def to_bytes(x: np.ndarray, scale: np.ndarray, zero: np.ndarray | int = 0) -> np.ndarray:
    """float32 [..., C] -> uint8 [..., C]."""
    return np.rint(np.clip(x * (F(1) / scale) + np.asarray(zero, F), 0, 255)).astype(np.uint8)
