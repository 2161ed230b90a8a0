"""LPIPS, through the network in cap4d/perceptual."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cap4d.evaluate.metrics.metric import Better, NotMeasured
from cap4d.evaluate.metrics.weights import Weights
from cap4d.evaluate.pair import Pair

if TYPE_CHECKING:
    from cap4d.perceptual.lpips import Lpips


class LpipsMetric:
    """Learned perceptual image patch similarity, 0 for equal images: Zhang et al. 2018, "The Unreasonable
    Effectiveness of Deep Features as a Perceptual Metric", VGG16 with the weights of version 0.1.

    Images in [-1, 1], full image, unmasked, at their own size.
    """

    name, unit, decimals = "LPIPS", "", 4
    better: Better = "lower"

    def __init__(self, network: Lpips) -> None:
        self._network = network

    def measure(self, pair: Pair) -> float:
        import torch

        image, truth = (torch.from_numpy(x) * 2 - 1 for x in (pair.image, pair.truth))
        with torch.inference_mode():
            return float(self._network(image, truth))


def find(weights: Weights) -> LpipsMetric | NotMeasured:
    """
    Raises:
        ArgumentError: The folder that was given lacks a file.
        DataError: A file is not what it should be.
    """
    try:
        from cap4d.perceptual.lpips import LPIPS_NEEDS, find_lpips, load_lpips
    except ModuleNotFoundError as error:
        return NotMeasured("LPIPS", f"the package {error.name} (pip install 'cap4d[fit]')")
    files = find_lpips(weights.lpips)
    if files is None:
        return NotMeasured("LPIPS", LPIPS_NEEDS.removeprefix("LPIPS needs "))
    return LpipsMetric(load_lpips(files))
