"""Fits that are killed, stopped or find their checkpoint spoiled end where they would have ended."""

import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny_avatar import GRID, tiny_rig, write_tiny_capture

from cap4d.avatar.checkpoint import load_latest, previous_of, save_checkpoint
from cap4d.avatar.fit import fit
from cap4d.avatar.presets import Densify, preset_named
from cap4d.errors import DataError

TESTS = Path(__file__).parents[1]
KILLED_AFTER = (0.0, 0.13, 0.31)  # s since the first checkpoint: before, while and after others are written
FIT = """
import sys
from pathlib import Path
from test_fit_interrupted import slow_fit
from cap4d.errors import exit_code
import logging
logging.basicConfig(level=logging.INFO, format="%(message)s")
sys.exit(exit_code("cap4d", lambda: slow_fit(Path(sys.argv[1]), Path(sys.argv[2])) and 0))
"""


def tiny_preset():
    from dataclasses import replace

    return replace(
        preset_named("debug", "short"),
        iterations=90,
        image_size=48,
        grid_size=GRID,
        deformer_width=4,
        gaussians=600,
        expression_noise=0.02,
        densify=Densify(start=30, stop=60, every=30, most=800),
        checkpoint_every=7,
    )


def slow_fit(capture: Path, output: Path, *, resume: bool = False):
    return fit([capture], tiny_rig(), output, preset=tiny_preset(), resume=resume, device="cpu")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    path = tmp_path_factory.mktemp("captures") / "sheet"
    write_tiny_capture(path)
    return path


@pytest.fixture(scope="module")
def whole(capture, tmp_path_factory):
    output = tmp_path_factory.mktemp("fits") / "whole.cap4d"
    slow_fit(capture, output)
    return output.read_bytes()


def started(capture: Path, output: Path, threads: str) -> subprocess.Popen:
    """A fit in a process of its own that has written a checkpoint."""
    environment = {**os.environ, "PYTHONPATH": f"{TESTS}:{TESTS / 'e2e'}", "CAP4D_THREADS": threads}
    process = subprocess.Popen(
        [sys.executable, "-c", FIT, str(capture), str(output)], env=environment, stderr=subprocess.PIPE
    )
    deadline = time.monotonic() + 60
    while not output.with_suffix(".fit.ckpt").exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.005)
    return process


@pytest.mark.parametrize("delay", KILLED_AFTER)
def test_a_killed_fit_goes_on_to_the_same_bytes(capture, whole, tmp_path, delay):
    """On two threads before the kill, and on as many as there are after it."""
    output = tmp_path / "x.cap4d"
    process = started(capture, output, "2")
    time.sleep(delay)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert not output.exists()
    slow_fit(capture, output, resume=True)
    assert output.read_bytes() == whole
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.cap4d", "x.fit.json", "x.fit.png"]


def test_ctrl_c_saves_and_says_how_to_go_on(capture, whole, tmp_path):
    output = tmp_path / "x.cap4d"
    process = started(capture, output, "1")
    process.send_signal(signal.SIGINT)
    lines = process.communicate(timeout=60)[1].decode().splitlines()
    assert process.returncode == 130
    assert sum("the same command with --resume goes on" in line for line in lines) == 1
    assert not any("Traceback" in line for line in lines)
    slow_fit(capture, output, resume=True)
    assert output.read_bytes() == whole


def test_a_spoiled_checkpoint_costs_some_steps_and_not_the_fit(capture, whole, tmp_path, caplog):
    output = tmp_path / "x.cap4d"
    checkpoint = output.with_suffix(".fit.ckpt")
    process = started(capture, output, "1")
    while not previous_of(checkpoint).exists():
        assert process.poll() is None
        time.sleep(0.005)
    process.kill()
    process.communicate()
    if not checkpoint.exists():  # killed between the two renames
        checkpoint.write_bytes(previous_of(checkpoint).read_bytes())
    data = bytearray(checkpoint.read_bytes())
    data[len(data) // 2] ^= 1
    checkpoint.write_bytes(data)
    with caplog.at_level(logging.WARNING):
        slow_fit(capture, output, resume=True)
    lines = [r.message for r in caplog.records if r.levelno == logging.WARNING]
    assert len(lines) == 1 and "checkpoint: expected bytes as they were written" in lines[0]
    assert output.read_bytes() == whole


def test_where_both_are_spoiled_it_is_said(tmp_path):
    path = tmp_path / "x.fit.ckpt"
    for _ in range(2):
        save_checkpoint({"kind": "a"}, path)
    assert load_latest(path, kind="a") == {"kind": "a"}
    for file in (path, previous_of(path)):
        file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(DataError, match=r"previous: checkpoint: expected bytes"):
        load_latest(path, kind="a")
    assert load_latest(tmp_path / "none.fit.ckpt", kind="a") is None
