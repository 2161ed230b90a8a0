"""Checkpoints of the released system: what is read of them, and what is refused."""

from __future__ import annotations

import os
import pickle
import struct
import tracemalloc
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
from official_checkpoint import official_state, write_official
from torch import nn

from cap4d.avatar.deformer import Deformer
from cap4d.errors import DataError
from cap4d.transfer.official import newest_checkpoint, read_official
from cap4d.transfer.torch_file import TorchFile

FACES, GAUSSIANS = 40, 100
SMALL = dict(gaussians=GAUSSIANS, faces=FACES, width=2, size=128)
DEGREE, XYZ, DC, REST, SCALING, ROTATION, OPACITY, BINDING, COUNTER = range(9)


@pytest.fixture
def state() -> tuple[dict, int]:
    return official_state(**SMALL)


def saved(path: Path, content: object) -> Path:
    torch.save(content, path)
    return path


def with_field(state: tuple[dict, int], index: int, value: object) -> tuple[dict, int]:
    fields = list(state[0]["gaussians"])
    fields[index] = value
    return {**state[0], "gaussians": tuple(fields)}, state[1]


def test_what_is_read_is_what_was_saved(tmp_path, state):
    official = read_official(saved(tmp_path / "chkpnt7.pth", state), faces=FACES)
    fields = state[0]["gaussians"]
    assert official.iteration == 100_000 and official.width == 2
    np.testing.assert_array_equal(official.shape, state[0]["shape"].numpy())
    pairs = {"means": XYZ, "quats": ROTATION, "log_scales": SCALING, "sh_dc": DC, "sh_rest": REST}
    for name, index in pairs.items():
        np.testing.assert_array_equal(official.gaussians[name], fields[index].detach().numpy())
    np.testing.assert_array_equal(official.gaussians["opacity_logits"], fields[OPACITY].detach()[:, 0])
    np.testing.assert_array_equal(official.binding, fields[BINDING].numpy())
    assert official.binding.dtype == np.int32
    network = Deformer(np.ones((128, 128), bool), width=2)
    network.load_state_dict({k: torch.from_numpy(v) for k, v in official.network.items()})
    for name, value in network.state_dict().items():
        torch.testing.assert_close(value, state[0]["deform_net"][name], rtol=0, atol=0)


def test_harmonics_above_the_degree_that_was_fitted_are_left_out(tmp_path, state):
    for degree, count in ((0, 0), (1, 3), (2, 8), (3, 15)):
        path = saved(tmp_path / "x.pth", with_field(state, DEGREE, degree))
        assert read_official(path, faces=FACES).gaussians["sh_rest"].shape == (GAUSSIANS, count, 3)


def test_numpy_arrays_lists_and_views_are_read_as_well(tmp_path, state, caplog):
    columns = torch.arange(GAUSSIANS * 3.0).reshape(3, GAUSSIANS)
    content, iteration = with_field(state, XYZ, columns.T)  # strides of its own, and an offset
    content["shape"] = state[0]["shape"].double().numpy()
    content["base_rot"] = torch.arange(9.0)[3:6]
    content["gaussians"] = list(content["gaussians"])
    official = read_official(saved(tmp_path / "x.pth", (content, iteration)), faces=FACES)
    np.testing.assert_array_equal(official.gaussians["means"], columns.numpy().T)
    np.testing.assert_array_equal(official.shape, state[0]["shape"].numpy())
    assert "base_rot is left aside" in caplog.text


def test_the_optimizer_is_not_read(tmp_path, state):
    path = saved(tmp_path / "chkpnt1.pth", state)
    with TorchFile(path) as file:
        adam = file.content[0]["gaussians"][12]
        moment = adam["state"][0]["exp_avg"]
    read = path.read_bytes()
    at = read.index(f"data/{moment.storage.key}".encode()) + 200
    path.write_bytes(read[:at] + bytes([read[at] ^ 1]) + read[at + 1 :])
    read_official(path, faces=FACES)  # whatever is in there
    with TorchFile(path) as file, pytest.raises(DataError, match=r"adam: .*CRC"):
        file.array("adam", moment)


def test_the_newest_checkpoint_is_taken(tmp_path):
    for name in ("chkpnt9000.pth", "chkpnt10000.pth", "chkpnt.pth", "best20000.pth", "chkpnt1e9.pth"):
        (tmp_path / name).touch()
    assert newest_checkpoint(tmp_path).name == "chkpnt10000.pth"
    assert newest_checkpoint(tmp_path / "chkpnt9000.pth").name == "chkpnt9000.pth"
    (tmp_path / "none").mkdir()
    with pytest.raises(DataError, match=r"none: folder: expected a file chkpntN\.pth, found none"):
        newest_checkpoint(tmp_path / "none")
    with pytest.raises(DataError, match=r"expected a folder with chkpntN\.pth, found No such file"):
        newest_checkpoint(tmp_path / "nowhere")


def with_nan(value: torch.Tensor) -> torch.Tensor:
    value = value.detach().clone()
    value.view(-1)[-1] = np.nan
    return value


FIELDS = {
    "gaussians fewer": (XYZ, lambda t: t[:50], r"_rotation: expected \[50, 4\], found \[100, 4\]"),
    "no gaussians": (XYZ, lambda t: t[:0], r"_xyz: expected 1 to 4194304 Gaussians, found 0"),
    "two coordinates": (XYZ, lambda t: t[:, :2], r"_xyz: expected \[\*, 3\], found \[100, 2\]"),
    "words": (XYZ, lambda t: "words", r"_xyz: expected a tensor, found str"),
    "nothing": (XYZ, lambda t: None, r"_xyz: expected a tensor, found NoneType"),
    "whole numbers that are large": (XYZ, lambda t: t.long() + 2**40, r"_xyz: expected numbers in \[-10000"),
    "nan": (XYZ, with_nan, r"_xyz: expected finite values, found 1 that are not"),
    "nan scale": (SCALING, with_nan, r"_scaling: expected finite values"),
    "infinite scale": (SCALING, lambda t: t + 1e3, r"_scaling: expected numbers in \[-60, 20\]"),
    "no rotation": (ROTATION, lambda t: t * 0, r"_rotation: .*norms of at least 1e-06, found 0"),
    "flat opacity": (OPACITY, lambda t: t[:, 0], r"_opacity: expected \[100, 1\], found \[100\]"),
    "channels first": (DC, lambda t: t.transpose(1, 2), r"_features_dc: expected \[100, 1, 3\]"),
    "degree": (DEGREE, lambda d: 4, r"active_sh_degree: expected 0 to 3, found 4"),
    "degree as text": (DEGREE, lambda d: "3", r"active_sh_degree: expected 0 to 3, found str"),
    "harmonics": (REST, lambda t: t[:, :7], r"_features_rest: expected harmonics of a degree up to 3"),
    "binding too large": (BINDING, lambda t: t + 1, r"binding: expected indices 0 to 39, found 40"),
    "binding negative": (BINDING, lambda t: t - 1, r"binding: expected indices 0 to 39, found -1"),
    "binding of floats": (BINDING, lambda t: t.float(), r"binding: expected index\[100\], found float32"),
    "counter of another mesh": (COUNTER, lambda t: t[:-1], r"binding_counter: expected \[40\], found \[39\]"),
}


@pytest.mark.parametrize("case", FIELDS)
def test_a_field_that_is_wrong_is_named(tmp_path, state, case):
    index, change, message = FIELDS[case]
    path = saved(tmp_path / "x.pth", with_field(state, index, change(state[0]["gaussians"][index])))
    with pytest.raises(DataError, match=message) as error:
        read_official(path, faces=FACES)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_counts_that_do_not_count_are_told(tmp_path, state, caplog):
    path = saved(tmp_path / "x.pth", with_field(state, COUNTER, state[0]["gaussians"][COUNTER] * 0))
    read_official(path, faces=FACES)
    assert "binding_counter does not count binding" in caplog.text


CONTENTS = {
    "no iteration": (lambda s: s[0], r"checkpoint: expected \(dict, iteration\), found dict of 4"),
    "a state dict": (lambda s: (s[0], "9"), r"checkpoint: expected \(dict, iteration\), found tuple of 2"),
    "no shape": (lambda s: ({**s[0], "shape": [0.0] * 150}, 1), "shape: expected a tensor, found list"),
    "another shape": (
        lambda s: ({**s[0], "shape": torch.zeros(300)}, 1),
        r"shape: expected \[150\], found \[300\]",
    ),
    "a shape of objects": (
        lambda s: ({**s[0], "shape": np.array([None] * 150)}, 1),
        "shape: expected an array, found .*elements of type",
    ),
    "no network": (
        lambda s: ({k: v for k, v in s[0].items() if k != "deform_net"}, 1),
        "deform_net: expected an entry of the checkpoint, found none",
    ),
    "an empty network": (
        lambda s: ({**s[0], "deform_net": OrderedDict()}, 1),
        r"deform_net model\.model\.0\.weight: expected \[1 to 256, 27, 4, 4\], found nothing",
    ),
    "a wide network": (
        lambda s: ({**s[0], "deform_net": {"model.model.0.weight": torch.zeros(512, 27, 4, 4)}}, 1),
        r"deform_net model\.model\.0\.weight: expected \[1 to 256, 27, 4, 4\], found \[512",
    ),
    "plain 3DGS": (lambda s: ({**s[0], "gaussians": s[0]["gaussians"][:12]}, 1), "expected a tuple of 14"),
}


@pytest.mark.parametrize("case", CONTENTS)
def test_a_checkpoint_of_something_else_is_refused(tmp_path, state, case):
    change, message = CONTENTS[case]
    with pytest.raises(DataError, match=message):
        read_official(saved(tmp_path / "x.pth", change(state)), faces=FACES)


class Shell:
    """Runs a command when it is unpickled."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


class Getter:
    """Calls what pickles are allowed to call, on what they are not given."""

    def __reduce__(self):
        return getattr, (dict, "keys")


CLASSES = {
    "a command": (lambda f: Shell(f"touch {f / 'pwned'}"), r"data\.pkl: expected tensors and .* \w+\.system"),
    "getattr": (lambda f: Getter(), r"data\.pkl: expected tensors and plain .*_*builtins?_*\.getattr"),
    "a module": (lambda f: nn.Linear(1, 1), r"found torch\.nn\.modules\.linear\.Linear"),
    "a path": (lambda f: Path("x"), r"found pathlib\."),
    "a dtype": (lambda f: torch.float32, r"found torch\.float32"),
}


@pytest.mark.parametrize("case", CLASSES)
def test_a_pickle_that_names_anything_else_is_refused_and_not_run(tmp_path, state, case):
    make, message = CLASSES[case]
    path = saved(tmp_path / "x.pth", ({**state[0], "more": make(tmp_path)}, 1))
    with pytest.raises(DataError, match=message):
        read_official(path, faces=FACES)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.pth"]


def zipped(path: Path, entries: dict[str, bytes], *, method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in entries.items():
            archive.writestr(f"x/{name}", data)
    return path


def tensor_pickle(shape: bytes, stride: bytes, *, offset: bytes = b"K\0", count: bytes = b"K\x04") -> bytes:
    """A pickle of one float32 tensor over storage 0; sizes and the like as opcodes."""
    storage = b"(X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\0" + b"0X\x03\0\0\0cpu" + count + b"tQ"
    tail = b"\x89ccollections\nOrderedDict\n)RtR."
    return b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(" + storage + offset + shape + stride + tail


IMPOSSIBLE = "impossible sizes, strides or offset"
VIEWS = {
    "beyond": (tensor_pickle(b"K\x05\x85", b"K\x01\x85"), "beyond 4 numbers|of 4 numbers"),
    "offset": (tensor_pickle(b"K\x02\x85", b"K\x01\x85", offset=b"K\x03"), "beyond 4 numbers"),
    "stride": (tensor_pickle(b"K\x02\x85", b"K\x04\x85"), "beyond 4 numbers"),
    "negative stride": (tensor_pickle(b"K\x02\x85", b"J\xff\xff\xff\xff\x85"), IMPOSSIBLE),
    "negative offset": (tensor_pickle(b"K\x02\x85", b"K\x01\x85", offset=b"J\xff\xff\xff\xff"), IMPOSSIBLE),
    "one number a billion times": (tensor_pickle(b"J\0\0\0\x0f\x85", b"K\0\x85"), "of 4 numbers"),
    "text for a size": (tensor_pickle(b"X\x01\0\0\0" + b"a\x85", b"K\x01\x85"), IMPOSSIBLE),
    "a size of 2000 bits": (
        tensor_pickle(b"\x8a\xfa" + 249 * b"\xff" + b"\x01\x85", b"K\x01\x85"),
        IMPOSSIBLE,
    ),
    "other lengths": (tensor_pickle(b"K\x02\x85", b")"), IMPOSSIBLE),
    "another size of storage": (tensor_pickle(b"K\x02\x85", b"K\x01\x85", count=b"K\x05"), "found 16 bytes"),
    "a storage without end": (
        tensor_pickle(b"K\x02\x85", b"K\x01\x85", count=b"J\0\0\0\x7f"),
        "of another kind",
    ),
}


@pytest.mark.parametrize("case", VIEWS)
def test_a_tensor_that_reaches_beyond_its_storage_is_refused(tmp_path, case):
    data, message = VIEWS[case]
    path = zipped(tmp_path / "x.pth", {"data.pkl": data, "data/0": struct.pack("<4f", 1, 2, 3, 4)})
    with pytest.raises(DataError, match=message), TorchFile(path) as file:
        file.array("tensor", file.content)


def test_the_same_pickle_with_sizes_that_fit_is_read(tmp_path):
    data = tensor_pickle(b"K\x02\x85", b"K\x02\x85", offset=b"K\x01")
    for order, code in (("little", "<4f"), ("big", ">4f")):
        entries = {"data.pkl": data, "byteorder": order.encode(), "data/0": struct.pack(code, 1, 2, 3, 4)}
        with TorchFile(zipped(tmp_path / "x.pth", entries)) as file:
            np.testing.assert_array_equal(file.array("tensor", file.content), [2, 4])


def pickled(value: object) -> dict[str, bytes]:
    return {"data.pkl": pickle.dumps(value, 2)}


ARCHIVES = {
    "compressed": (
        lambda p: zipped(p, pickled({}), method=zipfile.ZIP_DEFLATED),
        "data.pkl: expected at most 16777216 bytes, stored",
    ),
    "a large pickle": (
        lambda p: zipped(p, {"data.pkl": bytes((1 << 24) + 1)}),
        "data.pkl: expected at most 16777216 bytes",
    ),
    "no pickle": (lambda p: zipped(p, {"data/0": b""}), "expected an entry data.pkl, found none"),
    "a cut pickle": (
        lambda p: zipped(p, {"data.pkl": pickle.dumps([1, 2], 2)[:-2]}),
        "data.pkl: expected tensors and plain containers",
    ),
    "no zip": (lambda p: p.write_bytes(b"words" * 99), "file: expected a zip, as torch.save writes"),
    "nothing": (lambda p: p.touch(), "file: expected a zip"),
    "the old format": (
        lambda p: torch.save({}, p, _use_new_zipfile_serialization=False),
        r"file: expected a zip \(write it again with torch 1\.6 or newer\), found torch's old format",
    ),
    "another order": (
        lambda p: zipped(p, {**pickled({}), "byteorder": b"middle"}),
        "byteorder: expected little or big",
    ),
    "a state for a function": (
        lambda p: zipped(p, {"data.pkl": b"\x80\x02ctorch._utils\n_rebuild_parameter\n}b."}),
        "data.pkl: expected tensors and plain containers",
    ),
}


def doubled(levels: int) -> bytes:
    """Operations for a tuple of the last tuple twice, and so on: 2^levels ends in a few bytes."""
    return b")q\0" + b"".join(b"h%ch%c\x86q%c" % (i, i, i + 1) for i in range(levels))


BOMBS = {
    "a number for the memo": (b"}r\0\0\0\x7f.", "expected \\(dict, iteration\\), found dict of 0"),
    "a key of tuples of tuples": (b"}(" + doubled(200) + b"tNs.", "unhashable type: 'tuple'"),
    "one made by torch.Size": (
        b"}ctorch\nSize\n((" + doubled(200) + b"ttRNs.",
        "unhashable type: 'tuple'",
    ),
    "a set of them": (b"\x8f(" + doubled(200) + b"\x90.", "data.pkl: expected tensors and plain"),
    "a state for a kind of storage": (
        b"ctorch\nFloatStorage\n}X\x04\0\0\0nameX\x0b\0\0\0LongStoragesb.",
        "a state for what has none",
    ),
    "a state for a function": (b"c_codecs\nencode\n}X\x01\0\0\0aNsb.", "a state for what has none"),
    "a state for a tensor": (
        tensor_pickle(b"K\x01\x85", b"K\x01\x85")[2:-1] + b"}X\x05\0\0\0shapeNsb.",
        "a state for what has none",
    ),
}


@pytest.mark.parametrize("case", BOMBS)
def test_a_pickle_that_would_eat_time_memory_or_the_reader_is_refused_at_once(tmp_path, case):
    operations, message = BOMBS[case]
    path = zipped(tmp_path / "x.pth", {"data.pkl": b"\x80\x02" + operations})
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=message):
            read_official(path, faces=FACES)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()
    whole = zipped(
        tmp_path / "y.pth", {"data.pkl": tensor_pickle(b"K\x04\x85", b"K\x01\x85"), "data/0": bytes(16)}
    )
    with TorchFile(whole) as file:  # and nothing stays behind for the next file
        assert file.array("tensor", file.content).dtype == np.float32


def test_what_is_shown_of_a_wrong_number_is_short(tmp_path, state):
    for degree, found in ((4, "4"), ([[0] * 9], "list of 1"), (1 << 99, "int"), ("3", "str")):
        path = saved(tmp_path / "x.pth", with_field(state, DEGREE, degree))
        with pytest.raises(DataError, match=rf"active_sh_degree: expected 0 to 3, found {found}$"):
            read_official(path, faces=FACES)


def test_a_network_of_one_storage_over_and_over_is_not_read(tmp_path, state):
    large = torch.zeros(1 << 22)
    net = {**state[0]["deform_net"], **{f"more.{i}": large for i in range(130)}}
    path = saved(tmp_path / "x.pth", ({**state[0], "deform_net": net}, 1))
    with pytest.raises(DataError, match="deform_net: expected at most 536870912 numbers"):
        read_official(path, faces=FACES)


@pytest.mark.parametrize("case", ARCHIVES)
def test_an_archive_of_another_kind_is_refused(tmp_path, case):
    make, message = ARCHIVES[case]
    make(tmp_path / "x.pth")
    with pytest.raises(DataError, match=message) as error:
        TorchFile(tmp_path / "x.pth")
    assert "\n" not in str(error.value)


def test_a_pickle_nested_deeply_is_no_checkpoint(tmp_path):
    zipped(tmp_path / "x.pth", {"data.pkl": b"\x80\x02" + b"(" * 100_000 + b"t" * 100_000 + b"."})
    with pytest.raises(DataError, match=r"expected \(dict, iteration\)"):
        read_official(tmp_path / "x.pth", faces=FACES)


def test_every_cut_is_refused(tmp_path):
    path = write_official(tmp_path, **SMALL)
    whole = path.read_bytes()
    for size in np.random.default_rng(0).integers(0, len(whole) - 1, 12):
        path.write_bytes(whole[:size])
        with pytest.raises(DataError, match=r"chkpnt100000\.pth: "):
            read_official(path, faces=FACES)


def test_whatever_is_flipped_is_refused_or_harmless(tmp_path):
    path = write_official(tmp_path, **SMALL)
    whole = path.read_bytes()
    start = whole.index(b"data.pkl")
    rng, refused = np.random.default_rng(1), 0
    for at in start + rng.integers(0, 4000, 60):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << int(rng.integers(8)))]) + whole[at + 1 :])
        try:
            read_official(path, faces=FACES)
        except DataError:
            refused += 1
    assert refused > 40


def test_tensors_that_were_on_a_gpu_are_read(tmp_path):
    data = tensor_pickle(b"K\x02\x85", b"K\x01\x85").replace(
        b"ctorch\nFloat", b"ctorch.cuda\nFloat"
    ).replace(b"X\x03\0\0\0cpu", b"X\x06\0\0\0cuda:0")  # fmt: skip
    path = zipped(tmp_path / "x.pth", {"data.pkl": data, "data/0": struct.pack("<4f", 1, 2, 3, 4)})
    with TorchFile(path) as file:
        np.testing.assert_array_equal(file.array("tensor", file.content), [1, 2])


def test_a_clip_gives_the_default_view(tmp_path):
    from cap4d.transfer.official import read_clip, view_of

    still = np.zeros((3, 3), np.float32)
    arrays = {
        "expr": np.zeros((3, 65), np.float32),
        "eye_rot": still,
        "rot": still + np.float32([0, 0.3, 0]),
        "tra": still + np.float32([0, 0.1, -1.2]),
    }
    camera = {"extr": np.eye(4)[None], "resolutions": np.array([[400, 300]])}
    camera |= {name: np.full((1, 1), value) for name, value in zip(
        ("fx", "fy", "cx", "cy"), (900.0, 910.0, 150.0, 200.0), strict=True)}  # fmt: skip
    np.savez(tmp_path / "fit.npz", **arrays, **camera)
    view = view_of(tmp_path / "fit.npz", read_clip(tmp_path / "fit.npz"))
    assert (view.width, view.height) == (300, 400) and view.K[1, 1] == 910
    np.testing.assert_allclose(view.viewmat[:3, 3], [0, -0.1, 1.2], atol=1e-6)
    assert view.viewmat[0, 0] == pytest.approx(np.cos(0.3))
    np.savez(tmp_path / "no_camera.npz", **arrays)
    still_view = view_of(tmp_path / "no_camera.npz", read_clip(tmp_path / "no_camera.npz"))
    assert still_view.viewmat[2, 3] == pytest.approx(1.469, abs=1e-3)
    np.savez(tmp_path / "other.npz", **arrays, rig_name=np.array("ict"))
    with pytest.raises(DataError, match="rig_name: expected 'flame2023_no_jaw', found 'ict'"):
        read_clip(tmp_path / "other.npz")
    np.savez(tmp_path / "short.npz", **{**arrays, "expr": np.zeros((3, 64), np.float32)})
    with pytest.raises(DataError, match=r"expr: expected \[\*, 65\], found \[3, 64\]"):
        read_clip(tmp_path / "short.npz")


def test_layers_that_do_not_fit_are_named(tmp_path, state):
    from tiny_avatar import tiny_rig

    from cap4d.rig.grid import build_grid
    from cap4d.transfer.official import avatar_model

    rig = tiny_rig()
    grid = build_grid(rig, 16)
    content, iteration = official_state(gaussians=len(grid.faces), faces=len(grid.faces), width=2, size=16)
    content["shape"] = torch.zeros(150)
    for change, message in (
        ({"model.model.3.bias": torch.zeros(4)}, r"deform_net model\.model\.3\.bias: expected \[3\], found"),
        ({"model.model.9.bias": torch.zeros(4)}, r"deform_net: expected .* found also model\.model\.9\.bias"),
    ):
        net = {**content["deform_net"], **change}
        path = saved(tmp_path / "x.pth", ({**content, "deform_net": net}, iteration))
        with pytest.raises(DataError, match=message):
            avatar_model(read_official(path, faces=len(grid.faces)), rig, grid, source=path)
    path = saved(tmp_path / "x.pth", (content, iteration))
    model = avatar_model(read_official(path, faces=len(grid.faces)), rig, grid, source=path)
    for name, value in model.deformer.named_parameters():
        torch.testing.assert_close(value, content["deform_net"][name], rtol=0, atol=0)
