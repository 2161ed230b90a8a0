"""The command line: help with examples, exit codes, one line per error."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from cap4d import ArgumentError, DataError, cli
from cap4d.errors import exit_code

COMMANDS = (
    ["demo"],
    ["rig"],
    ["rig", "import"],
    ["rig", "import", "flame"],
    ["rig", "import", "ict"],
    ["rig", "import", "builtin"],
    ["rig", "show"],
    ["synth"],
    ["track"],
    ["fit"],
    ["evaluate"],
    ["protocol"],
    ["protocol", "self-reenactment"],
    ["import"],
    ["import", "official"],
    ["import", "gaussian-avatars"],
    ["protocol", "cross-reenactment"],
    ["optimize"],
    ["render"],
    ["drive"],
    ["export"],
    ["inspect"],
    ["bench"],
)


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_has_help_with_an_example(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([*words, "--help"])
    assert stop.value.code == 0
    printed = capsys.readouterr().out
    assert f"example:\n  cap4d {' '.join(words)}" in printed


def parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """A parser and those of its commands."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                yield from parsers(each)


def test_every_argument_has_help() -> None:
    found = list(parsers(cli.build_parser()))
    assert len(found) == 1 + len(COMMANDS)
    for parser in found:
        assert parser.description and parser.epilog, parser.prog
        for action in parser._actions:
            if not isinstance(action, argparse._SubParsersAction):
                assert action.help, f"{parser.prog} {action.dest}"


def test_fit_says_what_held_out_means(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["fit", "--help"])
    printed = " ".join(capsys.readouterr().out.split())
    assert (
        "held-out frames (every 10th and the last tenth of a video, or those the capture marks) are never "
        "trained on; their expressions and poses come from the tracker, which sees all frames." in printed
    )


@pytest.mark.parametrize(
    "line",
    [
        "rig import flame missing.pkl -o no/r.npz",
        "rig import ict missing -o no/r.npz",
        "rig import builtin -o no/r.npz",
        "rig show missing.npz -o no/r.png",
        "track missing.mp4 --rig missing.npz -o no/capture",
        "fit missing --rig missing.npz -o no/me.cap4d",
    ],
)
def test_the_output_is_checked_first(line: str, tmp_path: Path, monkeypatch, capsys) -> None:
    for package in ("torch", "OpenImageIO", "cv2"):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    assert cli.main(line.split()) == 2
    assert capsys.readouterr().err.startswith("cap4d: output: the folder of no/")
    assert not list(tmp_path.iterdir())


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
