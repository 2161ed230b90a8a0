"""The command line: help with examples, exit codes, one line per error."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from cap4d import ArgumentError, DataError, cli

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
    ],
)
def test_errors_become_one_line_and_a_code(error, code, monkeypatch, capsys) -> None:
    def fail(path: Path) -> str:
        raise error

    monkeypatch.setattr("cap4d.bundle.inspect.describe", fail)
    assert cli.main(["inspect", "me.cap4d"]) == code
    assert capsys.readouterr().err.count("\n") == 1


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\nfrom cap4d import cli\ntry: cli.main(['--help'])\nexcept SystemExit: pass\n"
        "print([m for m in ('torch', 'onnxruntime', 'OpenImageIO', 'mediapipe') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
