"""The command line: help with examples, exit codes, one line per error."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cap4d import ArgumentError, DataError, cli
from cap4d.errors import exit_code

COMMANDS = (
    ["demo"],
    ["rig", "import", "flame"],
    ["rig", "import", "ict"],
    ["rig", "import", "builtin"],
    ["rig", "show"],
    ["track"],
    ["fit"],
    ["render"],
    ["inspect"],
)


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_has_help_with_an_example(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([*words, "--help"])
    assert stop.value.code == 0
    printed = capsys.readouterr().out
    assert f"example:\n  cap4d {' '.join(words)}" in printed


def test_an_unknown_command_exits_with_2() -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["no-such-command"])
    assert stop.value.code == 2


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (DataError("me.cap4d", "manifest.json", expected="a\nJSON object", found="nothing"), 1),
        (ArgumentError("no such rig"), 2),
        (KeyboardInterrupt(), 130),
        (PermissionError(13, "Permission denied", "out/a.png"), 1),
        (OSError(28, "No space left on device"), 1),
        (OSError("12 requested and 0 written"), 1),
        (ModuleNotFoundError("No module named 'torch'", name="torch"), 2),
    ],
)
def test_errors_become_one_line_and_a_code(error, code, monkeypatch, capsys) -> None:
    def fail(path: Path) -> str:
        raise error

    monkeypatch.setattr("cap4d.bundle.inspect.describe", fail)
    assert cli.main(["inspect", "me.cap4d"]) == code
    assert capsys.readouterr().err.count("\n") == 1


def test_errors_of_the_system_name_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def read() -> None:
        tmp_path.read_bytes()

    assert exit_code("cap4d", read) == 1
    assert capsys.readouterr().err == f"cap4d: {tmp_path}: Is a directory\n"


@pytest.mark.parametrize(("package", "extra"), [("onnx", "cap4d[fit]"), ("cv2", "cap4d[track]")])
def test_a_missing_package_says_how_to_get_it(package, extra, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, package, None)  # importing it now fails as if it were not there
    assert exit_code("cap4d", lambda: __import__(package)) == 2
    assert f"pip install '{extra}'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "error",
    [
        ModuleNotFoundError("No module named 'cap4d.nothing'", name="cap4d.nothing"),
        ModuleNotFoundError("No module named 'torch._C'", name="torch._C"),
        ImportError("cannot import name 'fit' from 'cap4d.avatar.fit'", name="cap4d.avatar.fit"),
        ValueError("a bug"),
    ],
)
def test_bugs_keep_their_traceback(error: Exception) -> None:
    def fail() -> None:
        raise error

    with pytest.raises(type(error)):
        exit_code("cap4d", fail)


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\nfrom cap4d import cli\ntry: cli.main(['--help'])\nexcept SystemExit: pass\n"
        "print([m for m in ('torch', 'onnxruntime', 'OpenImageIO', 'mediapipe') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
