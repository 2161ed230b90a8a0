"""The network in 8-bit integers: its arithmetic against NumPy's, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from quantized_reference import random_network, reference

from cap4d import _core
from cap4d.bundle.quantized_unet import LARGEST, check_quantized, quantized_specs
from cap4d.errors import DataError

SIZE, WIDTH = 16, 4


def offsets_of(size: int, *, seed: int = 1) -> np.ndarray:
    """Smooth offsets of some millimetres."""
    rng = np.random.default_rng(seed)
    at = (np.arange(size) + 0.5) / size
    waves = [
        np.sin(9 * a * at[:, None] + c) * np.cos(9 * b * at + d) for a, b, c, d in rng.uniform(size=(3, 4))
    ]
    return (0.01 * np.array(waves)).astype(np.float32)


@pytest.fixture
def tensors() -> dict[str, np.ndarray]:
    return random_network(SIZE, WIDTH)


@pytest.mark.parametrize(
    ("size", "width"),
    [(8, 1), (8, 5), (16, 24), (16, 16), (32, 16), (64, 24), (64, 64), (128, 16), (128, 64), (256, 4)],
)
def test_answers_are_the_references_to_the_last_bit(size: int, width: int) -> None:
    network, offsets = random_network(size, width), offsets_of(size)
    expected = reference(network, offsets)
    found = _core.QuantizedUnet(network, size).run(offsets)
    assert expected.std() > 1e-4
    np.testing.assert_array_equal(found, expected)


def test_a_second_frame_owes_nothing_to_the_first() -> None:
    network = random_network(32, 16)
    unet, one, two = _core.QuantizedUnet(network, 32), offsets_of(32), offsets_of(32, seed=2)
    first = unet.run(one)
    assert not np.array_equal(unet.run(two), first)
    np.testing.assert_array_equal(unet.run(one), first)


@pytest.mark.parametrize("threads", [2, 3, 7, 64])
def test_any_number_of_threads_gives_the_same_bits(threads: int) -> None:
    network, offsets = random_network(64, 24), offsets_of(64)
    unet = _core.QuantizedUnet(network, 64)
    np.testing.assert_array_equal(unet.run(offsets, threads), unet.run(offsets, 1))


def test_offsets_off_the_mask_are_not_read(tensors: dict[str, np.ndarray]) -> None:
    unet, offsets = _core.QuantizedUnet(tensors, SIZE), offsets_of(SIZE)
    changed = np.where(tensors["mask"], offsets, np.float32(7))
    np.testing.assert_array_equal(unet.run(changed), unet.run(offsets))


def test_dead_channels_stay_dead(tensors: dict[str, np.ndarray]) -> None:
    # A channel that is the same everywhere has no variance to divide by.
    tensors["down1.weight"][1] = 0
    tensors["up1.weight"][:, 2] = 0
    offsets = offsets_of(SIZE)
    found = _core.QuantizedUnet(tensors, SIZE).run(offsets)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found, reference(tensors, offsets))


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_offsets_that_are_not_finite_are_refused(tensors: dict[str, np.ndarray], poison: float) -> None:
    offsets = offsets_of(SIZE)
    offsets[1, 3, 5] = poison
    with pytest.raises(ValueError, match="offsets: expected finite numbers"):
        _core.QuantizedUnet(tensors, SIZE).run(offsets)


@pytest.mark.parametrize("size", [1e3, 1e30, 3e38])
def test_enormous_offsets_give_finite_answers(tensors: dict[str, np.ndarray], size: float) -> None:
    offsets = np.full((3, SIZE, SIZE), size, np.float32)
    offsets[:, ::2] *= -1
    assert np.isfinite(_core.QuantizedUnet(tensors, SIZE).run(offsets)).all()


@pytest.mark.parametrize("shape", [(3, SIZE, SIZE + 1), (2, SIZE, SIZE), (SIZE, SIZE)])
def test_offsets_of_another_shape_are_refused(tensors: dict[str, np.ndarray], shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="offsets: expected float32"):
        _core.QuantizedUnet(tensors, SIZE).run(np.zeros(shape, np.float32))


def test_a_sound_network_passes(tensors: dict[str, np.ndarray]) -> None:
    check_quantized(tensors, source="a.cap4d:deform", size=SIZE)


@pytest.mark.parametrize("name", sorted(quantized_specs(SIZE, WIDTH)))
def test_every_tensor_must_be_there_and_right(tensors: dict[str, np.ndarray], name: str) -> None:
    value = tensors[name]
    dtype = np.float64 if value.dtype == np.float32 else np.int16
    wrong = {
        "gone": None,
        "dtype": value.astype(dtype),
        "short": np.ascontiguousarray(value[:-1]),
        "long": np.concatenate([value, value[:1]]),
        "axes": value[None],
    }
    for bad in wrong.values():
        changed = {k: v for k, v in (tensors | {name: bad}).items() if v is not None}
        with pytest.raises(DataError) as refused:
            check_quantized(changed, source="a.cap4d:deform", size=SIZE)
        assert str(refused.value).startswith("a.cap4d:deform: ")
        with pytest.raises(ValueError, match=r"expected|wrong shape"):
            _core.QuantizedUnet(changed, SIZE)


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf, 2 * LARGEST, -2 * LARGEST])
def test_numbers_out_of_range_are_refused(tensors: dict[str, np.ndarray], poison: float) -> None:
    for name, value in tensors.items():
        if value.dtype == np.float32:
            value = value.copy()
            value.flat[-1] = poison
            with pytest.raises(DataError, match=name):
                check_quantized(tensors | {name: value}, source="a", size=SIZE)


@pytest.mark.parametrize("poison", [0.0, -1e-3, 1e-13])
def test_scales_must_be_positive(tensors: dict[str, np.ndarray], poison: float) -> None:
    for name in [name for name in tensors if name.endswith("scale")]:
        value = tensors[name].copy()
        value[0] = poison
        with pytest.raises(DataError, match=name):
            check_quantized(tensors | {name: value}, source="a", size=SIZE)


def test_strangers_are_refused(tensors: dict[str, np.ndarray]) -> None:
    with pytest.raises(DataError, match="only those of a quantised network"):
        check_quantized(tensors | {"down9.weight": np.zeros(1, np.int8)}, source="a", size=SIZE)


@pytest.mark.parametrize("size", [0, -16, 4, 12, 1024, 1 << 20])
def test_other_grid_sizes_are_refused(tensors: dict[str, np.ndarray], size: int) -> None:
    with pytest.raises(DataError, match="grid size"):
        check_quantized(tensors, source="a", size=size)
    with pytest.raises(ValueError, match="size: expected"):
        _core.QuantizedUnet(tensors, size)


def test_a_network_of_another_grid_is_refused(tensors: dict[str, np.ndarray]) -> None:
    with pytest.raises(DataError, match="only those of a quantised network"):  # a smaller one ends earlier
        check_quantized(tensors, source="a", size=2 * SIZE)
    with pytest.raises(ValueError, match="mask"):
        _core.QuantizedUnet(tensors, 2 * SIZE)


@pytest.mark.parametrize("width", [0, 257])
def test_widths_have_a_limit(tensors: dict[str, np.ndarray], width: int) -> None:
    wide = tensors | {"down0.weight": np.zeros((width, 3, 4, 4), np.float32)}
    with pytest.raises(DataError, match="1 to 256"):
        check_quantized(wide, source="a", size=SIZE)
    with pytest.raises(ValueError, match="1 to 256"):
        _core.QuantizedUnet(wide, SIZE)


def test_views_are_refused_not_misread(tensors: dict[str, np.ndarray]) -> None:
    turned = tensors | {"up1.weight": tensors["up1.weight"].swapaxes(2, 3)}
    with pytest.raises(ValueError, match=r"up1\.weight: expected a contiguous array"):
        _core.QuantizedUnet(turned, SIZE)


@pytest.mark.parametrize("poison", [np.nan, np.inf, 0.0, -1.0, 1e38, 1e-38])
def test_the_core_survives_unchecked_numbers(tensors: dict[str, np.ndarray], poison: float) -> None:
    # Reading and writing stay inside whatever the numbers are; only the answer may be rubbish.
    for name, value in tensors.items():
        if value.dtype == np.float32:
            bad = tensors | {name: np.full_like(value, poison)}
            assert _core.QuantizedUnet(bad, SIZE).run(offsets_of(SIZE)).shape == (3, SIZE, SIZE)
