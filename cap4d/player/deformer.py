"""The deformation network at run time: our own kernel, or onnxruntime for a network that it does not know."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping

import numpy as np

from cap4d import _core
from cap4d.bundle.float_unet import float_unet
from cap4d.errors import ArgumentError, DataError

MAX_THREADS = 4  # beyond it a batch of one at 128 x 128 gains nothing
TIMED_PASSES = 3

Network = Callable[[np.ndarray, np.ndarray], None]
"""(offsets, answer), both float32[3, S, S]; fills in the answer."""


class Deformer:
    """A loaded network: offsets float32[3, S, S] m -> deformation float32[3, S, S] m (facts 20-24).

    The pass is skipped while the offsets stay the same. Not for use from two threads at once.

    Args:
        network: The ONNX file, already scanned (`bundle.onnx_scan`), or the tensors of its int8 form, already
            checked (`bundle.quantized_unet`).
        size: S.
        source: For error messages.
        threads: 0: `CAP4D_THREADS`, else the machine's cores, at most four.
    Raises:
        DataError: It cannot be loaded.
    """

    def __init__(
        self,
        network: bytes | Mapping[str, np.ndarray],
        *,
        size: int,
        source: str = "deform.onnx",
        threads: int = 0,
    ) -> None:
        self.source, self.shape = source, (3, size, size)
        self._offsets = np.zeros(self.shape, np.float32)
        # In turns, so that one frame's answer is still there while the next frame's is made.
        self._answers = [np.zeros(self.shape, np.float32) for _ in range(2)]
        self._flags = np.empty(self.shape, bool)
        load = _onnx_network if isinstance(network, bytes) else _quantized_network
        try:
            self._network: Network = load(network, self._offsets, self._answers, threads or default_threads())
        except Exception as error:  # a runtime's own types; all mean that the network is not sound
            expected = "one that onnxruntime loads" if isinstance(network, bytes) else "one that runs"
            raise DataError(source, "network", expected=expected, found=str(error)[:200]) from None
        self.passes = 0

    def __call__(self, offsets: np.ndarray) -> np.ndarray:
        """The deformation for these offsets.

        The array is the deformer's own: it must not be written to, and the pass after the next overwrites it.

        Raises:
            ArgumentError: The offsets have another shape.
            DataError: The network fails, or answers with something that is not finite.
        """
        if offsets.shape != self.shape:
            raise ArgumentError(f"offsets: expected float32{list(self.shape)}, got {list(offsets.shape)}")
        if self.passes == 0 or not np.equal(offsets, self._offsets, out=self._flags).all():
            self._pass(offsets)
            self.passes += 1
        return self._answers[0]

    def milliseconds(self) -> float:
        """What a pass takes: the quickest of three after one that warms up. Forgets the last answer."""
        times, zeros = [], np.zeros(self.shape, np.float32)
        for _ in range(1 + TIMED_PASSES):
            start = time.perf_counter()
            self._pass(zeros)
            times.append(time.perf_counter() - start)
        return 1e3 * min(times[1:])

    def _pass(self, offsets: np.ndarray) -> None:
        self._answers.reverse()
        answer = self._answers[0]
        np.copyto(self._offsets, offsets)
        try:
            self._network(self._offsets, answer)
        except Exception as error:  # as above
            self._offsets.fill(np.nan)  # equal to nothing: the next call tries again
            found = str(error)[:200]
            raise DataError(self.source, "network", expected="one that runs", found=found) from None
        if not np.isfinite(answer, out=self._flags).all():
            self._offsets.fill(np.nan)
            expected, found = f"finite float32{list(self.shape)}", "a value that is not finite"
            raise DataError(self.source, "deformation", expected=expected, found=found)


def _onnx_network(model: bytes, offsets: np.ndarray, answers: list[np.ndarray], threads: int) -> Network:
    """The exported U-Net in our own float32; any other in onnxruntime.

    onnxruntime hands a layer's work to its threads and waits for all of them some thirty times a pass, and
    makes two passes over memory where one will do: 1.75 ms where ours takes 1.11 (width 16), 18.8 where ours
    takes 15.0 (width 64; two threads of a Zen 4).
    """
    tensors = float_unet(model, offsets.shape[-1])
    if tensors is None:
        return _foreign_network(model, offsets, answers, threads)
    return _own_network(_core.FloatUnet(tensors, offsets.shape[-1]), threads)


def _foreign_network(model: bytes, offsets: np.ndarray, answers: list[np.ndarray], threads: int) -> Network:
    """onnxruntime on the memory of these very arrays: a pass allocates nothing that the first did not.

    `session.set_denormal_as_zero` is left alone: it gains nothing here, and it would change the arithmetic of
    the caller's thread for good.
    """
    import onnxruntime  # takes 0.2 s, and an avatar of our own does without

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # Threads that spin between passes take the cores from the renderer: 29 ms a frame instead of 15.5 (two
    # cores). Within a pass they may: 2.2 ms instead of 2.4 at width 16.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    # The "fallback" would try the same again and print a banner.
    session = onnxruntime.InferenceSession(
        model, options, providers=["CPUExecutionProvider"], enable_fallback=0
    )

    def bound(answer: np.ndarray):
        binding, shape = session.io_binding(), (1, *answer.shape)
        binding.bind_input("offsets", "cpu", 0, np.float32, shape, offsets.ctypes.data)
        binding.bind_output("deformation", "cpu", 0, np.float32, shape, answer.ctypes.data)
        return binding

    bindings = {answer.ctypes.data: bound(answer) for answer in answers}

    def run(_: np.ndarray, answer: np.ndarray) -> None:
        session.run_with_iobinding(bindings[answer.ctypes.data])

    return run


def _quantized_network(
    tensors: Mapping[str, np.ndarray], offsets: np.ndarray, answers: list[np.ndarray], threads: int
) -> Network:
    return _own_network(_core.QuantizedUnet(dict(tensors), offsets.shape[-1]), threads)


def _own_network(unet: _core.QuantizedUnet | _core.FloatUnet, threads: int) -> Network:
    """Its threads are the renderer's: awake from one stage of a frame to the next, and no longer."""

    def run(offsets: np.ndarray, answer: np.ndarray) -> None:
        unet.run(offsets, threads, answer)

    return run


def default_threads() -> int:
    """`CAP4D_THREADS`, or the number of cores, at most four."""
    wanted = os.environ.get("CAP4D_THREADS", "")
    return int(wanted) if wanted.isdigit() and int(wanted) > 0 else min(os.cpu_count() or 1, MAX_THREADS)
