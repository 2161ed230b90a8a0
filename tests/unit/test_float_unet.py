"""The network in float32: read out of its ONNX file, its answers, and what is not taken for it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import numpy_helper
from tiny_bundle import tiny_grid, tiny_network

from cap4d import _core
from cap4d.avatar.deformer import Deformer as TorchDeformer
from cap4d.bundle.float_unet import float_unet
from cap4d.bundle.onnx_half import halve_weights
from cap4d.errors import DataError
from cap4d.export.deformer import export_deformer
from cap4d.player.deformer import Deformer

SIZE, WIDTH = 16, 4


def network(size: int, width: int) -> bytes:
    """ONNX: random weights, an answer of some millimetres, a mask with holes."""
    generator = torch.Generator().manual_seed(width)
    mask = np.random.default_rng(size).random((size, size)) < 0.8
    net = TorchDeformer(mask, width=width, generator=generator)
    torch.nn.init.normal_(net.model.model[-1].weight, std=0.02, generator=generator)
    torch.nn.init.normal_(net.model.model[-1].bias, std=0.1, generator=generator)
    return export_deformer(net)


def offsets_of(size: int, *, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 0.01, (3, size, size)).astype(np.float32)


def onnx_answer(model: bytes, offsets: np.ndarray) -> np.ndarray:
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    return session.run(None, {"offsets": offsets[None]})[0][0]


@pytest.fixture(scope="module")
def model() -> bytes:
    return network(SIZE, WIDTH)


@pytest.fixture
def tensors(model: bytes) -> dict[str, np.ndarray]:
    return float_unet(model, SIZE)


@pytest.mark.parametrize("stored", [bytes, halve_weights], ids=["float32", "float16"])
@pytest.mark.parametrize(
    ("size", "width"), [(8, 1), (8, 5), (16, 24), (32, 16), (64, 24), (128, 16), (64, 64), (256, 4)]
)
def test_answers_are_those_of_onnxruntime(size: int, width: int, stored: Callable[[bytes], bytes]) -> None:
    model, offsets = stored(network(size, width)), offsets_of(size)
    expected = onnx_answer(model, offsets)
    found = _core.FloatUnet(float_unet(model, size), size).run(offsets)
    assert expected.std() > 1e-4
    assert np.abs(found - expected).max() < 2e-6 * np.ptp(expected)


def test_the_player_runs_it(model: bytes, tensors: dict[str, np.ndarray]) -> None:
    offsets = offsets_of(SIZE)
    found = Deformer(model, size=SIZE)(offsets)
    np.testing.assert_array_equal(found, _core.FloatUnet(tensors, SIZE).run(offsets))


def test_a_second_frame_owes_nothing_to_the_first(tensors: dict[str, np.ndarray]) -> None:
    unet, one, two = _core.FloatUnet(tensors, SIZE), offsets_of(SIZE), offsets_of(SIZE, seed=2)
    first = unet.run(one)
    assert not np.array_equal(unet.run(two), first)
    np.testing.assert_array_equal(unet.run(one), first)


@pytest.mark.parametrize("threads", [2, 3, 7, 64])
@pytest.mark.parametrize("width", [16, 24])
def test_any_number_of_threads_gives_the_same_bits(threads: int, width: int) -> None:
    unet, offsets = _core.FloatUnet(float_unet(network(64, width), 64), 64), offsets_of(64)
    np.testing.assert_array_equal(unet.run(offsets, threads), unet.run(offsets, 1))


def test_the_answer_goes_where_it_is_asked_for(tensors: dict[str, np.ndarray]) -> None:
    unet, offsets = _core.FloatUnet(tensors, SIZE), offsets_of(SIZE)
    out = np.zeros((3, SIZE, SIZE), np.float32)
    found = unet.run(offsets, 1, out)
    assert np.shares_memory(found, out)
    np.testing.assert_array_equal(out, unet.run(offsets))


@pytest.mark.parametrize("shape", [(3, SIZE, SIZE - 1), (SIZE, SIZE), (3, SIZE, 2 * SIZE)])
def test_an_answer_of_another_shape_is_refused(
    tensors: dict[str, np.ndarray], shape: tuple[int, ...]
) -> None:
    with pytest.raises(ValueError, match="out: expected float32"):
        _core.FloatUnet(tensors, SIZE).run(offsets_of(SIZE), 1, np.zeros(shape, np.float32))


def test_an_answer_that_may_not_be_written_is_refused(tensors: dict[str, np.ndarray]) -> None:
    out = np.zeros((3, SIZE, SIZE), np.float32)
    out.flags.writeable = False
    with pytest.raises(ValueError, match="not writeable"):
        _core.FloatUnet(tensors, SIZE).run(offsets_of(SIZE), 1, out)


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_offsets_that_are_not_finite_are_refused(tensors: dict[str, np.ndarray], poison: float) -> None:
    offsets = offsets_of(SIZE)
    offsets[1, 3, 5] = poison
    with pytest.raises(ValueError, match="offsets: expected finite numbers"):
        _core.FloatUnet(tensors, SIZE).run(offsets)


def test_an_answer_that_is_not_finite_is_a_data_error(model: bytes) -> None:
    large = changed(model, lambda graph: scale(graph, "model.model.3.weight", 1e38))
    huge = changed(large, lambda graph: scale(graph, "metres", 1e10))
    assert float_unet(huge, SIZE) is not None
    with pytest.raises(DataError, match="deformation: expected finite"):
        Deformer(huge, size=SIZE)(offsets_of(SIZE))


def test_offsets_off_the_mask_are_not_read(tensors: dict[str, np.ndarray]) -> None:
    unet, offsets = _core.FloatUnet(tensors, SIZE), offsets_of(SIZE)
    poisoned = np.where(tensors["mask"], offsets, np.float32(7))
    np.testing.assert_array_equal(unet.run(poisoned), unet.run(offsets))


def test_dead_channels_stay_dead(model: bytes) -> None:
    # A channel that is the same everywhere has no variance to divide by.
    dead = changed(model, lambda graph: scale(graph, "model.model.1.model.1.weight", 0))
    found = _core.FloatUnet(float_unet(dead, SIZE), SIZE).run(offsets_of(SIZE))
    assert np.abs(found - onnx_answer(dead, offsets_of(SIZE))).max() < 2e-6 * np.ptp(found)


def test_every_tensor_must_be_there_and_right(tensors: dict[str, np.ndarray]) -> None:
    for name, value in tensors.items():
        for bad in (None, value.astype(np.float64), value[:-1], value[None]):
            kept = {k: v for k, v in (tensors | {name: bad}).items() if v is not None}
            with pytest.raises(ValueError, match=r"expected|wrong shape"):
                _core.FloatUnet(kept, SIZE)


def changed(model: bytes, change: Callable) -> bytes:
    proto = onnx.load_from_string(model)
    change(proto.graph)
    return proto.SerializeToString()


def scale(graph, name: str, factor: float) -> None:
    tensor = next(t for t in graph.initializer if t.name == name)
    tensor.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensor) * np.float32(factor), name))


def set_scale(graph) -> None:
    tensor = graph.initializer[0]
    values = numpy_helper.to_array(tensor).copy()
    values[0, 0, 3, 3] = 12
    tensor.CopyFrom(numpy_helper.from_array(values, "scale"))


def another_size(graph) -> None:
    tensor = next(t for t in graph.initializer if t.name == "model.model.1.model.1.weight")
    tensor.CopyFrom(numpy_helper.from_array(np.zeros((8, 5, 4, 4), np.float32), tensor.name))


OTHERS = {
    "a weight too few": lambda graph: graph.initializer.pop(1),
    "a tensor too many": lambda graph: graph.initializer.append(
        numpy_helper.from_array(np.zeros(3, np.float32), "more")
    ),
    "one name twice": lambda graph: graph.initializer.append(graph.initializer[1]),
    "another shape": another_size,
    "a mask in two steps": set_scale,
    "ones that are twos": lambda graph: scale(graph, "ones_8", 2),
    "another operator": lambda graph: setattr(graph.node[-5], "op_type", "Sigmoid"),
    "another slope": lambda graph: setattr(graph.node[9].attribute[0], "f", 0.3),
    "another stride": lambda graph: graph.node[6].attribute[2].ints.__setitem__(0, 1),
    "an attribute too few": lambda graph: graph.node[6].attribute.pop(),
    "another input": lambda graph: graph.node[-5].input.__setitem__(0, "offsets"),
    "a node too few": lambda graph: graph.node.pop(),
    "nodes in another order": lambda graph: graph.node.append(graph.node.pop(1)),
    "a second output": lambda graph: graph.node[3].output.append("more"),
}


@pytest.mark.parametrize("change", OTHERS.values(), ids=OTHERS)
def test_another_network_is_not_taken_for_it(model: bytes, change: Callable) -> None:
    assert float_unet(model, SIZE) is not None
    assert float_unet(changed(model, change), SIZE) is None


@pytest.mark.parametrize("size", [0, 8, 12, 32, 1 << 20])
def test_another_grid_is_not_taken_for_it(model: bytes, size: int) -> None:
    assert float_unet(model, size) is None


@pytest.mark.parametrize("data", [b"", b"rubbish" * 10, b"\x3a\x00"])
def test_rubbish_is_not_taken_for_it(data: bytes) -> None:
    assert float_unet(data, SIZE) is None


def test_a_network_of_another_kind_is_onnxruntimes() -> None:
    model, offsets = tiny_network(tiny_grid(SIZE)), offsets_of(SIZE)
    assert float_unet(model, SIZE) is None
    np.testing.assert_array_equal(Deformer(model, size=SIZE)(offsets), onnx_answer(model, offsets))
