"""LPIPS: how different two pictures look to VGG16 (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep
Features as a Perceptual Metric", version 0.1 of their weights). Plain torch; the weights come from the user.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cap4d.errors import ArgumentError, DataError

TRUNK_FILE = "vgg16-397923af.pth"  # as torch hub names torchvision's file
LINEAR_FILE = "vgg.pth"  # as the lpips package and torch hub name LPIPS's own weights
PACKAGED = {"lpips": "weights/v0.1", "torchmetrics": "functional/image/lpips_models"}
MOST_BYTES = 1 << 30  # torchvision's file has 528 MB

TRUNK_URL = f"https://download.pytorch.org/models/{TRUNK_FILE}"
LINEAR_URL = "https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/vgg.pth"
LPIPS_NEEDS = (
    f"LPIPS needs VGG16's weights ({TRUNK_FILE} from {TRUNK_URL}) and its own ({LINEAR_FILE} from "
    f"{LINEAR_URL}), "
    "both in torch hub's cache (~/.cache/torch/hub/checkpoints) or in the folder given as --lpips-weights"
)

# Channels of VGG16's convolutions in units of the first ones' (64), and the ReLUs after which LPIPS looks.
STAGES = ((1, 1), (2, 2), (4, 4, 4), (8, 8, 8), (8, 8, 8))
WIDTH = 64
# ImageNet's mean and deviation for images in [-1, 1]; of the published network, to its digits.
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
EPS = 1e-10


@dataclass(frozen=True)
class LpipsFiles:
    """Where the weights are.

    Args:
        trunk: State dict of torchvision's `vgg16`.
        linear: State dict of the lpips package's `lin` layers.
    """

    trunk: Path
    linear: Path


class Lpips(nn.Module):
    """The distance of two pictures, 0 for equal ones.

    At five depths of VGG16 the channels are scaled to unit length in every pixel, and the squared differences
    are weighed per channel and averaged over the picture.

    Args:
        width: Channels of the first stage: 64, fewer only in tests.
    """

    def __init__(self, *, width: int = WIDTH) -> None:
        super().__init__()
        self.stages = nn.ModuleList()
        channels = 3
        for stage in STAGES:
            convolutions = nn.ModuleList()
            for multiple in stage:
                convolutions.append(nn.Conv2d(channels, multiple * width, 3, padding=1))
                channels = multiple * width
            self.stages.append(convolutions)
        self.weights = nn.ParameterList(torch.zeros(stage[-1] * width) for stage in STAGES)
        self.register_buffer("shift", torch.tensor(SHIFT)[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE)[:, None, None], persistent=False)
        self.requires_grad_(False)

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        """The distance of two [H, W, 3] images in [-1, 1], each side at least 16 px. A scalar.

        The gradient goes to both where they want one.
        """
        pairs = zip(self.features(image), self.features(target), self.weights, strict=True)
        return sum((weights[:, None, None] * (x - y).square()).sum(0).mean() for x, y, weights in pairs)

    def features(self, image: Tensor) -> list[Tensor]:
        """The [C, h, w] maps after every stage, of unit length in every pixel."""
        if image.ndim != 3 or image.shape[-1] != 3 or min(image.shape[:2]) < 16:
            raise ArgumentError(f"image: expected [H >= 16, W >= 16, 3], got {list(image.shape)}")
        x = (image.permute(2, 0, 1) - self.shift) / self.scale
        maps = []
        for depth, convolutions in enumerate(self.stages):
            x = F.max_pool2d(x, 2) if depth else x
            for convolution in convolutions:
                x = F.relu(convolution(x[None])[0])
            maps.append(_of_unit_length(x))
        return maps


def find_lpips(path: Path | None) -> LpipsFiles | None:
    """The weights in a folder, or where torch hub and the lpips package keep them.

    Args:
        path: A folder with both files; None looks into the usual places.
    Returns:
        None where nothing is said and nothing is found.
    Raises:
        ArgumentError: A folder was given, but lacks a file.
    """
    if path is not None:
        files = LpipsFiles(path / TRUNK_FILE, path / LINEAR_FILE)
        for file in (files.trunk, files.linear):
            if not file.is_file():
                raise ArgumentError(f"lpips weights: expected {file.name} in {path}; {LPIPS_NEEDS}")
        return files
    trunk = Path(torch.hub.get_dir()) / "checkpoints" / TRUNK_FILE
    linear = next((p for p in _linear_places() if p.is_file()), None)
    return LpipsFiles(trunk, linear) if trunk.is_file() and linear is not None else None


def load_lpips(files: LpipsFiles, *, width: int = WIDTH) -> Lpips:
    """The network with its weights, on the CPU.

    Raises:
        DataError: A file is no state dict of this network.
    """
    network = Lpips(width=width)
    with torch.no_grad():
        trunk = _state(files.trunk)
        _copy(files.trunk, trunk, _trunk_tensors(network), ignored="classifier.")
        linear = _state(files.linear)
        _copy(files.linear, linear, _linear_tensors(network), ignored=None)
    return network


def _of_unit_length(x: Tensor) -> Tensor:
    # Where every channel is 0, a norm has no gradient: there it is added to, which changes nothing else.
    squares = x.square().sum(0, keepdim=True)
    return x / (torch.where(squares > 0, squares, EPS**2).sqrt() + EPS)


def _linear_places() -> Iterable[Path]:
    yield Path(torch.hub.get_dir()) / "checkpoints" / LINEAR_FILE
    from importlib.util import find_spec

    for package, folder in PACKAGED.items():
        spec = find_spec(package)
        for place in (spec and spec.submodule_search_locations) or ():
            yield Path(place) / folder / LINEAR_FILE


def _trunk_tensors(network: Lpips) -> dict[str, Tensor]:
    """torchvision's names: one number for every convolution, ReLU and pooling."""
    tensors, number = {}, 0
    for convolutions in network.stages:
        for convolution in convolutions:
            tensors[f"features.{number}.weight"] = convolution.weight
            tensors[f"features.{number}.bias"] = convolution.bias
            number += 2
        number += 1
    return tensors


def _linear_tensors(network: Lpips) -> dict[str, Tensor]:
    return {f"lin{i}.model.1.weight": w.view(1, -1, 1, 1) for i, w in enumerate(network.weights)}


def _state(path: Path) -> Mapping[str, Tensor]:
    if path.stat().st_size > MOST_BYTES:
        raise DataError(path, "size", expected=f"at most {MOST_BYTES} bytes", found=path.stat().st_size)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its unpickler, zip reader and storages raise
        raise DataError(path, "weights", expected="a state dict", found=type(error).__name__) from error
    if not isinstance(state, Mapping) or not all(isinstance(v, Tensor) for v in state.values()):
        raise DataError(path, "weights", expected="a state dict", found=type(state).__name__)
    return state


def _copy(
    path: Path, state: Mapping[str, Tensor], tensors: dict[str, Tensor], *, ignored: str | None
) -> None:
    """Every tensor from its namesake; none may be missing, left over, misshapen or not finite."""
    extra = [k for k in state if k not in tensors and not (ignored and str(k).startswith(ignored))]
    if extra:
        raise DataError(path, str(extra[0]), expected="no such tensor", found="one")
    for name, tensor in tensors.items():
        value = state.get(name)
        shape = f"finite float{list(tensor.shape)}"
        if value is None:
            raise DataError(path, name, expected=shape, found=None)
        if value.shape != tensor.shape or not value.is_floating_point() or not value.isfinite().all():
            raise DataError(path, name, expected=shape, found=f"{value.dtype}{list(value.shape)}")
        tensor.copy_(value)
