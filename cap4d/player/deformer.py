"""The deformation network at run time: onnxruntime on a few threads that do not spin."""

from __future__ import annotations

import os

import numpy as np
import onnxruntime

from cap4d.errors import DataError

MAX_THREADS = 4  # beyond it a batch of one at 128 x 128 gains nothing


class Deformer:
    """A loaded network: offsets float32[3, S, S] m -> deformation float32[3, S, S] m (facts 20-24).

    The pass is skipped while the offsets stay the same.

    Args:
        model: The ONNX file, already scanned (`bundle.onnx_scan`).
        size: S.
        source: For error messages.
        threads: 0: `CAP4D_THREADS`, else the machine's cores, at most four.
    Raises:
        DataError: onnxruntime cannot load it.
    """

    def __init__(self, model: bytes, *, size: int, source: str = "deform.onnx", threads: int = 0) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads or default_threads()
        options.inter_op_num_threads = 1
        options.log_severity_level = 4
        # Spinning threads take the cores from the renderer: 37-41 ms a frame instead of 21-23 (two cores).
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self.source, self.size = source, size
        try:
            # The "fallback" would try the same again and print a banner.
            self.session = onnxruntime.InferenceSession(
                model, options, providers=["CPUExecutionProvider"], enable_fallback=0
            )
        except Exception as error:  # onnxruntime's own types; all mean that the network is not sound
            raise DataError(
                source, "network", expected="one that onnxruntime loads", found=str(error)[:200]
            ) from None
        self.passes = 0
        self._offsets: np.ndarray | None = None
        self._deformation = np.zeros((3, size, size), np.float32)

    def __call__(self, offsets: np.ndarray) -> np.ndarray:
        """The deformation for these offsets; the array is the deformer's own and must not be written to.

        Raises:
            DataError: The network fails, or answers with something that is not finite.
        """
        if self._offsets is None or not np.array_equal(offsets, self._offsets):
            self._deformation = self._run(offsets)
            self._offsets = offsets.copy()
            self.passes += 1
        return self._deformation

    def _run(self, offsets: np.ndarray) -> np.ndarray:
        shape = (1, 3, self.size, self.size)
        try:
            (answer,) = self.session.run(["deformation"], {"offsets": offsets.reshape(shape)})
        except Exception as error:  # as above
            raise DataError(
                self.source, "network", expected="one that runs", found=str(error)[:200]
            ) from None
        if answer.shape != shape or answer.dtype != np.float32 or not np.isfinite(answer).all():
            found = f"{answer.dtype}{list(answer.shape)}, finite: {bool(np.isfinite(answer).all())}"
            raise DataError(self.source, "deformation", expected=f"finite float32{list(shape)}", found=found)
        return answer[0]


def default_threads() -> int:
    """`CAP4D_THREADS`, or the number of cores, at most four."""
    wanted = os.environ.get("CAP4D_THREADS", "")
    return int(wanted) if wanted.isdigit() and int(wanted) > 0 else min(os.cpu_count() or 1, MAX_THREADS)
