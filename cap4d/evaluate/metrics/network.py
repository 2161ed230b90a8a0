"""A network of the user, as ONNX: read with checks, and run on one image."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cap4d.errors import ArgumentError, DataError

MOST_BYTES = 1 << 30
CPU = "CPUExecutionProvider"


class Network:
    """Takes float32[1, 3, size, size], answers with float32 arrays by name.

    Args:
        path: The file.
        size: Pixels a side of its input.
    Raises:
        ArgumentError: There is no such file.
        DataError: It is no ONNX network with one such input.
    """

    def __init__(self, path: Path, *, size: int) -> None:
        import onnxruntime

        self.path, self.size = path, size
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4
        options.add_session_config_entry("session.force_spinning_stop", "1")
        _check_file(path)
        try:
            # By its path: large networks keep weights in files beside them; onnxruntime takes no others.
            self._session = onnxruntime.InferenceSession(
                str(path), options, providers=[CPU], enable_fallback=0
            )
        except Exception as error:  # onnxruntime raises a type for every one of its codes
            found = str(error)[:200]
            raise DataError(path, "network", expected="ONNX that loads", found=found) from None
        self._input = self._checked_input()
        self.outputs = {output.name: list(output.shape) for output in self._session.get_outputs()}

    def __call__(self, image: np.ndarray) -> dict[str, np.ndarray]:
        """Runs float32[size, size, 3].

        Raises:
            DataError: The network fails, or answers with something that is not finite numbers.
        """
        planes = np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32)
        try:
            answers = self._session.run(None, {self._input: planes})
        except Exception as error:  # as above
            raise DataError(self.path, "network", expected="one that runs", found=str(error)[:200]) from None
        named = dict(zip(self.outputs, answers, strict=True))
        for name, answer in named.items():
            if getattr(answer, "dtype", None) != np.float32 or not np.isfinite(answer).all():
                found = getattr(answer, "dtype", type(answer).__name__)
                raise DataError(self.path, name, expected="finite float32", found=found)
        return named

    def flat(self, name: str, answers: dict[str, np.ndarray], lengths: Sequence[int]) -> np.ndarray:
        """One answer as a vector whose length is among those expected."""
        vector = answers[name].reshape(-1)
        if len(vector) not in lengths:
            expected = " or ".join(map(str, lengths))
            raise DataError(self.path, name, expected=f"{expected} numbers", found=len(vector))
        return vector

    def _checked_input(self) -> str:
        """The name of the only input, whose known sizes are [1, 3, size, size]."""
        inputs = self._session.get_inputs()
        wanted = [1, 3, self.size, self.size]
        shape = list(inputs[0].shape) if len(inputs) == 1 else [list(x.shape) for x in inputs]
        known = len(inputs) == 1 and len(shape) == 4 and inputs[0].type == "tensor(float)"
        fits = known and all(
            not isinstance(n, int) or n in (m, -1) for n, m in zip(shape, wanted, strict=True)
        )
        if not fits:
            found = f"{[x.type for x in inputs]} {shape}"
            raise DataError(self.path, "input", expected=f"one float32{wanted}", found=found)
        return inputs[0].name


def _check_file(path: Path) -> None:
    try:
        with open(path, "rb"):
            size = path.stat().st_size
    except OSError as error:
        raise ArgumentError(f"{path}: cannot be read: {error.strerror}") from error
    if size > MOST_BYTES:
        raise DataError(path, "size", expected=f"at most {MOST_BYTES} bytes", found=size)
