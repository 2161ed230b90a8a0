"""The network at run time: its cache, its threads, its refusals."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

pytest.importorskip("onnx")

from tiny_bundle import tiny_grid, tiny_network

from cap4d.errors import ArgumentError, DataError
from cap4d.player.deformer import Deformer, default_threads

SIZE = 8


@pytest.fixture(scope="module")
def model() -> bytes:
    return tiny_network(tiny_grid(SIZE))


def offsets(seed: int) -> np.ndarray:
    return (0.003 * np.random.default_rng(seed).normal(size=(3, SIZE, SIZE))).astype(np.float32)


def test_the_last_answer_is_kept(model: bytes) -> None:
    deformer = Deformer(model, size=SIZE)
    first = deformer(offsets(0))
    assert deformer(offsets(0)) is first and deformer.passes == 1
    assert not np.array_equal(deformer(offsets(1)), first) and deformer.passes == 2
    assert np.array_equal(deformer(offsets(0)), first) and deformer.passes == 3


def test_the_cache_survives_a_reused_buffer(model: bytes) -> None:
    deformer, buffer = Deformer(model, size=SIZE), offsets(0)
    first = deformer(buffer).copy()
    buffer[:] = offsets(1)
    assert not np.array_equal(deformer(buffer), first)


def test_an_answer_outlives_the_next_pass(model: bytes) -> None:
    deformer = Deformer(model, size=SIZE)
    first = deformer(offsets(0))
    kept = first.copy()
    second = deformer(offsets(1))
    assert np.array_equal(first, kept) and not np.shares_memory(first, second)


def test_a_pass_allocates_no_map() -> None:
    size = 64
    deformer = Deformer(tiny_network(tiny_grid(size)), size=size)
    frames = [np.full((3, size, size), 1e-3 * k, np.float32) for k in range(4)]
    for frame in frames:
        deformer(frame)
    tracemalloc.start()
    try:
        for frame in frames:
            deformer(frame)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert deformer.passes == 8 and peak < size * size


def test_offsets_of_another_shape_are_refused(model: bytes) -> None:
    with pytest.raises(ArgumentError, match=r"offsets: expected float32\[3, 8, 8\], got \[3, 16, 16\]"):
        Deformer(model, size=SIZE)(np.zeros((3, 16, 16), np.float32))


def test_the_answer_does_not_depend_on_the_number_of_threads(model: bytes) -> None:
    one, four = (Deformer(model, size=SIZE, threads=n)(offsets(3)) for n in (1, 4))
    np.testing.assert_allclose(one, four, atol=1e-8)


@pytest.mark.parametrize("data", [b"", b"rubbish" * 10])
def test_what_onnxruntime_cannot_load_is_a_data_error(data: bytes, capfd: pytest.CaptureFixture) -> None:
    with pytest.raises(DataError, match=r"here: network: expected one that onnxruntime loads"):
        Deformer(data, size=SIZE, source="here")
    assert capfd.readouterr() == ("", ""), "one line is the command line's to print"


def test_tensors_that_are_no_network_are_a_data_error() -> None:
    with pytest.raises(DataError, match=r"here: network: expected one that runs, found down0\.weight"):
        Deformer({"weight": np.zeros(3, np.int8)}, size=SIZE, source="here")


def test_an_operator_that_cannot_run_is_a_data_error(model: bytes, capfd: pytest.CaptureFixture) -> None:
    import onnx

    proto = onnx.load_from_string(model)
    del proto.graph.node[1].attribute[:]
    with pytest.raises(DataError, match="network"):
        Deformer(proto.SerializeToString(), size=SIZE)(offsets(0))
    assert capfd.readouterr() == ("", "")


def test_another_size_is_a_data_error(model: bytes) -> None:
    with pytest.raises(DataError, match="network"):
        Deformer(model, size=16)(np.zeros((3, 16, 16), np.float32))


def test_an_answer_that_is_not_finite_is_a_data_error(model: bytes) -> None:
    poisoned = offsets(0)
    poisoned[0, 3, 3] = np.inf
    with pytest.raises(DataError, match="deformation: expected finite"):
        Deformer(_unbounded(model), size=SIZE)(poisoned)


def _unbounded(model: bytes) -> bytes:
    """The tiny network without its tanh, so that infinities go through."""
    import onnx

    proto = onnx.load_from_string(model)
    proto.graph.node[2].op_type = "Identity"
    return proto.SerializeToString()


def test_threads_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAP4D_THREADS", "3")
    assert default_threads() == 3
    for wrong in ("0", "-1", "many", ""):
        monkeypatch.setenv("CAP4D_THREADS", wrong)
        assert 1 <= default_threads() <= 4
