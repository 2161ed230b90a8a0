"""The inert unpickler: reads the arrays of head models, runs nothing, refuses everything else by name."""

from __future__ import annotations

import os
import pickle
import sys
import types

import numpy as np
import pytest

from cap4d.errors import DataError
from cap4d.rig.unpickle import read_pickle


@pytest.fixture
def chumpy(monkeypatch):
    """A stand-in for the chumpy package, only to write files the way it does."""
    module, package = types.ModuleType("chumpy.ch"), types.ModuleType("chumpy")
    kind = type("Ch", (), {"__module__": "chumpy.ch", "__qualname__": "Ch"})
    module.Ch = kind
    monkeypatch.setitem(sys.modules, "chumpy", package)
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    return kind


def write(path, content, protocol=2):
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", [2, 3, 4])
@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<u4", "i1", "?"])
def test_arrays(tmp_path, protocol, dtype):
    array = np.arange(12).reshape(3, 4).astype(dtype)
    content = {"c": array, "fortran": np.asfortranarray(array), "empty": array[:0], "text": "lbs"}
    read = read_pickle(write(tmp_path / "a.pkl", content, protocol))
    for name in ("c", "fortran", "empty"):
        np.testing.assert_array_equal(read[name], content[name])
        assert read[name].dtype == array.dtype
    assert read["text"] == "lbs"


def test_chumpy_arrays(tmp_path, chumpy):
    wrapped = chumpy()
    wrapped.__dict__.update(x=np.arange(3.0), dterms=("x",), _dirty_vars=set())
    read = read_pickle(write(tmp_path / "a.pkl", {"v": wrapped}))
    np.testing.assert_array_equal(read["v"], [0, 1, 2])


@pytest.mark.parametrize("kind", ["csc_matrix", "csr_matrix"])
def test_sparse_matrices(tmp_path, kind):
    sparse = pytest.importorskip("scipy.sparse")
    dense = np.where(np.random.default_rng(0).uniform(size=(5, 9)) < 0.3, 1.5, 0)
    read = read_pickle(write(tmp_path / "a.pkl", {"J": getattr(sparse, kind)(dense)}))
    np.testing.assert_array_equal(read["J"], dense)


def test_old_module_names(tmp_path):
    """Files written by Python 2 and old NumPy and SciPy name modules that are gone."""
    data = pickle.dumps({"a": np.arange(3)}, protocol=2)
    for name in (b"numpy._core.multiarray", b"numpy.core.multiarray"):
        old = data.replace(b"numpy._core.multiarray", name).replace(b"numpy.core.multiarray", name)
        (tmp_path / "a.pkl").write_bytes(old)
        np.testing.assert_array_equal(read_pickle(tmp_path / "a.pkl")["a"], [0, 1, 2])


class Runs:
    """Calls a function when unpickled in the ordinary way."""

    def __init__(self, function, *args):
        self.call = function, args

    def __reduce__(self):
        return self.call


HOSTILE = {
    "posix.system": (os.system, "touch {marker}"),
    "builtins.eval|__builtin__.eval": (eval, "open('{marker}', 'w')"),
    "builtins.getattr|__builtin__.getattr": (getattr, object, "__class__"),
    "os.mkdir|posix.mkdir": (os.mkdir, "{marker}"),
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("protocol", [2, 4])
def test_hostile_pickle_is_refused_by_name_and_runs_nothing(tmp_path, name, protocol):
    marker = tmp_path / "marker"
    function, *args = HOSTILE[name]
    args = [a.format(marker=marker) if isinstance(a, str) else a for a in args]
    path = write(tmp_path / "evil.pkl", {"v_template": Runs(function, *args)}, protocol)
    with pytest.raises(DataError, match=name) as caught:
        read_pickle(path)
    assert not marker.exists()
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_named_modules_are_not_imported(tmp_path):
    (tmp_path / "evil.pkl").write_bytes(b"cantigravity\nfly\n.")
    with pytest.raises(DataError, match=r"antigravity\.fly"):
        read_pickle(tmp_path / "evil.pkl")
    assert "antigravity" not in sys.modules


def test_known_names_used_wrongly(tmp_path):
    """The few known names do nothing but keep what they are given."""
    programs = {
        "huge array": b"cnumpy\nndarray\n((I1000000000000\ntI1\ntR.",
        "foreign encoding": b"c_codecs\nencode\n(Vabc\nVzlib\ntR.",
        "object of objects": b"ccopyreg\n_reconstructor\n(I1\nI2\nI3\ntR.",
        "stack underflow": b"R.",
        "no end": b"(lp0\n",
        "a list": b"(lp0\n.",
        "other keys": b"(dI1\nI2\ns.",
    }
    for name, program in programs.items():
        (tmp_path / "bad.pkl").write_bytes(program)
        with pytest.raises(DataError):
            pytest.fail(f"{name}: {read_pickle(tmp_path / 'bad.pkl')}")


def test_array_state_that_lies(tmp_path):
    good = pickle.dumps({"v": np.arange(4, dtype=np.int64)}, protocol=2)
    path = tmp_path / "bad.pkl"
    for old, new in ((b"K\x04\x85", b"K\x05\x85"), (b"X\x02\x00\x00\x00i8", b"X\x02\x00\x00\x00O8")):
        assert old in good
        path.write_bytes(good.replace(old, new))
        with pytest.raises(DataError, match="v: expected an array"):
            read_pickle(path)


def test_sparse_index_out_of_range(tmp_path):
    sparse = pytest.importorskip("scipy.sparse")
    matrix = sparse.csc_matrix(np.eye(3))
    matrix.indices[1] = 7
    with pytest.raises(DataError, match=r"J: expected an array, found .*out of range"):
        read_pickle(write(tmp_path / "a.pkl", {"J": matrix}))


def test_missing_and_truncated(tmp_path):
    with pytest.raises(DataError, match="expected a pickle"):
        read_pickle(tmp_path / "none.pkl")
    path = write(tmp_path / "a.pkl", {"v": np.arange(100)})
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(DataError, match="whole and plain pickle"):
        read_pickle(path)


def test_what_would_eat_time_memory_or_the_reader(tmp_path):
    doubled = b"(" + b")q\0" + b"".join(b"h%ch%c\x86q%c" % (i, i, i + 1) for i in range(200)) + b"t"
    dtype = b"cnumpy\ndtype\n(%stR(I3\nV<\ntb"
    array = b"cnumpy\nndarray\n)R(I1\n%s%sI00\nX\0\0\0\0tb"
    programs = {
        "a number for the memo": (b"}r\0\0\0\x7f.", None),
        "a key of tuples of tuples": (b"}" + doubled + b"Ns.", "unhashable type: 'tuple'"),
        "a state for a function": (b"c_codecs\nencode\n}X\1\0\0\0aNsb.", "a state for what has none"),
        "a type of tuples of tuples": (
            b"}X\1\0\0\0v" + array % (b")", dtype % doubled) + b"s.",
            "v: expected an array, found .*without a name",
        ),
        "a shape of lists": (
            b"}X\1\0\0\0v" + array % (b"(]J\xff\xff\xff\x7ft", dtype % b"Vi1\n") + b"s.",
            "v: expected an array, found .*other than some whole numbers",
        ),
    }
    for name, (program, message) in programs.items():
        (tmp_path / "bad.pkl").write_bytes(b"\x80\x02" + program)
        if message is None:
            assert read_pickle(tmp_path / "bad.pkl") == {}, name
            continue
        with pytest.raises(DataError, match=message):
            pytest.fail(f"{name}: {read_pickle(tmp_path / 'bad.pkl')}")
