"""Checkpoints with the structure that the released CAP4D code writes (fact 44), made of random numbers.

    python tests/official_checkpoint.py FOLDER [--gaussians 103152] [--width 64]

Parameters, an Adam state after a step, a scheduler's NumPy rates and all: what a real one holds, one of ours
does, too.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import nn

from cap4d.avatar.deformer import Deformer

FACES = 28_120  # fact 18
NAMES = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")


def official_state(
    *, gaussians: int = 30_000, faces: int = FACES, width: int = 4, size: int = 128, seed: int = 0
) -> tuple[dict, int]:
    """(dict, iteration) as `torch.save` is given it: every face has a Gaussian, the rest lie anywhere."""
    generator = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    n = gaussians
    extra = torch.randint(faces, (n - faces,), generator=generator)
    binding = torch.cat([torch.arange(faces), extra])
    values = {
        "xyz": 0.2 * normal(n, 3),
        "f_dc": 0.4 * normal(n, 1, 3) + 0.3,
        "f_rest": 0.05 * normal(n, 15, 3),
        "opacity": 2 + normal(n, 1),
        "scaling": 0.3 * normal(n, 3) - 0.5,
        "rotation": normal(n, 4) + torch.tensor([3.0, 0, 0, 0]),
    }
    parameters = {name: nn.Parameter(value) for name, value in values.items()}
    network = official_network(width=width, size=size, generator=generator)
    fields = (
        3,
        *(parameters[name] for name in ("xyz", "f_dc", "f_rest", "scaling", "rotation", "opacity")),
        binding,
        torch.bincount(binding, minlength=faces).int(),
        torch.zeros(n),
        torch.zeros(n, 1),
        torch.zeros(n, 1),
        adam_state(parameters, network),
        1.0,
    )
    state = {
        "shape": 0.7 * normal(150),
        "base_rot": torch.zeros(3),
        "deform_net": network.state_dict(),
        "gaussians": fields,
    }
    return state, 100_000


def official_network(*, width: int, size: int, generator: torch.Generator) -> Deformer:
    """A U-Net whose answers are of some millimetres, as a fitted one's are."""
    network = Deformer(np.ones((size, size), bool), width=width, generator=generator)
    last = network.model.model[-1]
    nn.init.normal_(last.weight, std=0.04 / width**0.5, generator=generator)
    nn.init.normal_(last.bias, std=0.1, generator=generator)
    return network


def adam_state(parameters: dict[str, nn.Parameter], network: nn.Module) -> dict:
    """Adam's state after a step, with a rate as schedulers make it: a number of NumPy's."""
    groups = [{"params": [parameter], "name": name, "lr": 1e-3} for name, parameter in parameters.items()]
    groups.append({"params": list(network.parameters()), "name": "deform_net", "weight_decay": 2e-3})
    optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    for group in optimizer.param_groups:
        group["lr"] = np.float64(0.0)
        for parameter in group["params"]:
            parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    for parameter in [*parameters.values(), *network.parameters()]:
        parameter.grad = None
    return optimizer.state_dict()


def write_official(folder: Path, **options: int) -> Path:
    """Writes `chkpnt100000.pth` into the folder, and returns its path."""
    state = official_state(**options)
    path = folder / f"chkpnt{state[1]}.pth"
    torch.save(state, path)
    return path


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Writes a checkpoint as the released code does.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--gaussians", type=int, default=103_152)
    parser.add_argument("--width", type=int, default=64)
    words = parser.parse_args()
    print(write_official(words.folder, gaussians=words.gaussians, width=words.width))
