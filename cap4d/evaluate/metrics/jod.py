"""JOD, through FovVideoVDP."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from importlib.util import find_spec

import numpy as np

from cap4d.evaluate.metrics.metric import Better, NotMeasured
from cap4d.evaluate.metrics.weights import Weights
from cap4d.evaluate.pair import Pair

DISPLAY = "standard_4k"
MODULES = ("torch", "pyfvvdp", "ffmpeg", "past", "imageio", "scipy")
NEEDS = (
    "FovVideoVDP (pip install 'cap4d[jod]', then pip install --no-deps pyfvvdp; its licence, CC BY-NC 4.0, "
    "is for non-commercial use only)"
)


class JustObjectionableDifference:
    """Quality in just-objectionable-difference units: 10 for no visible difference, and one less for a
    difference that 75 % of people object to. Mantiuk et al. 2021, "FovVideoVDP: A visible difference
    predictor for wide field-of-view video".

    Through pyfvvdp, not foveated, on its display `standard_4k` (30 inch, 200 cd/m^2, 75 px per degree).
    Frames of one camera that follow each other are a video at the capture's rate, and each of them has the
    video's JOD; a frame without neighbours is a still. Full image, unmasked, both on the same background.
    """

    name, unit, decimals = "JOD", "", 3
    better: Better = "higher"

    def __init__(self) -> None:
        import torch

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # it takes parts of SciPy from old places
            import pyfvvdp

            self._predictor = pyfvvdp.fvvdp(display_name=DISPLAY, quiet=True, device=torch.device("cpu"))

    def measure(self, pair: Pair) -> float:
        """Of a still."""
        return self.measure_video(iter([pair]), count=1, fps=0)

    def measure_video(self, pairs: Iterator[Pair], *, count: int, fps: float) -> float:
        """Of `count` pairs of one size, which are taken one after the other; `fps` of one pair has no say."""
        import torch

        with torch.inference_mode():
            source = _source(pairs, count, fps)
            return float(self._predictor.predict_video_source(source)[0])


def _source(pairs: Iterator[Pair], count: int, fps: float):
    """What FovVideoVDP asks for frames: it wants them in order, the picture's before the truth's."""
    import torch
    from pyfvvdp.video_source import fvvdp_video_source_dm

    class Source(fvvdp_video_source_dm):
        def __init__(self) -> None:
            super().__init__(display_photometry=DISPLAY)
            self.at, self.pair = 0, next(pairs)

        def get_video_size(self) -> tuple[int, int, int]:
            return (*self.pair.truth.shape[:2], count)

        def get_frames_per_second(self) -> float:
            return fps if count > 1 else 0

        def get_test_frame(self, frame: int, device) -> torch.Tensor:
            return self._luminance(self._advanced(frame).image, device)

        def get_reference_frame(self, frame: int, device) -> torch.Tensor:
            return self._luminance(self._advanced(frame).truth, device)

        def _advanced(self, frame: int) -> Pair:
            while self.at < frame:
                self.at, self.pair = self.at + 1, next(pairs)
            return self.pair

        def _luminance(self, image: np.ndarray, device) -> torch.Tensor:
            """[1, 1, 1, H, W] cd/m^2."""
            rgb = self.dm_photometry.forward(torch.from_numpy(image).to(device))
            weights = torch.tensor(self.color_to_luminance, dtype=rgb.dtype, device=device)
            return (rgb @ weights)[None, None, None]

    return Source()


def find(weights: Weights) -> JustObjectionableDifference | NotMeasured:
    if any(find_spec(module) is None for module in MODULES):
        return NotMeasured("JOD", NEEDS)
    return JustObjectionableDifference()
