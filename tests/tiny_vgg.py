"""LPIPS weights of random numbers, in the two files and under the names that users have."""

from __future__ import annotations

from pathlib import Path

import torch

from cap4d.perceptual.lpips import LINEAR_FILE, TRUNK_FILE, LpipsFiles

# torchvision's numbers of VGG16's convolutions and their channels in units of the first ones'.
CONVOLUTIONS = {0: 1, 2: 1, 5: 2, 7: 2, 10: 4, 12: 4, 14: 4, 17: 8, 19: 8, 21: 8, 24: 8, 26: 8, 28: 8}
DEPTHS = (1, 2, 4, 8, 8)


def tiny_vgg_state(*, width: int = 4, seed: int = 0) -> dict[str, torch.Tensor]:
    """What torchvision's file holds, but narrower: `features.*` and something of a classifier."""
    generator, channels, state = torch.Generator().manual_seed(seed), 3, {}
    for number, multiple in CONVOLUTIONS.items():
        std = (2 / (9 * channels)) ** 0.5
        state[f"features.{number}.weight"] = std * torch.randn(
            multiple * width, channels, 3, 3, generator=generator
        )
        state[f"features.{number}.bias"] = 0.1 * torch.randn(multiple * width, generator=generator)
        channels = multiple * width
    state["classifier.0.weight"] = torch.zeros(2, 2)
    return state


def tiny_linear_state(*, width: int = 4, seed: int = 0) -> dict[str, torch.Tensor]:
    """What the lpips package's file holds: non-negative weights of every channel."""
    generator = torch.Generator().manual_seed(seed + 1)
    return {
        f"lin{i}.model.1.weight": torch.rand(1, multiple * width, 1, 1, generator=generator)
        for i, multiple in enumerate(DEPTHS)
    }


def write_tiny_vgg(folder: Path, *, width: int = 4, seed: int = 0) -> LpipsFiles:
    """Writes both files under their usual names."""
    files = LpipsFiles(folder / TRUNK_FILE, folder / LINEAR_FILE)
    torch.save(tiny_vgg_state(width=width, seed=seed), files.trunk)
    torch.save(tiny_linear_state(width=width, seed=seed), files.linear)
    return files
