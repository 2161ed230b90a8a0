"""Fits that are killed, stopped or find their checkpoint spoiled end where they would have ended."""

import logging
import multiprocessing
import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_avatar import GRID, tiny_rig, write_tiny_capture

from cap4d.avatar.checkpoint import load_latest, previous_of, save_checkpoint
from cap4d.avatar.fit import fit
from cap4d.avatar.presets import Densify, preset_named
from cap4d.errors import DataError, exit_code

KILLED_AFTER = (0.0, 0.13, 0.31)  # s since the first checkpoint: before, while and after others are written


@pytest.fixture(scope="module")
def nursery():
    """Makes processes of their own that have torch already: it takes longer to load than such a fit."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["cap4d.avatar.fit", "cap4d.export.bundle"])
    return context


def fit_apart(capture: Path, output: Path, log: Path, threads: str) -> None:
    """What a process does; its words go to `log`."""
    os.environ["CAP4D_THREADS"] = threads
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT), sys.stderr.fileno())
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr, force=True)
    sys.exit(exit_code("cap4d", lambda: slow_fit(capture, output) and 0))


def tiny_preset():
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


@pytest.fixture
def started(nursery, capture, tmp_path):
    """Starts a fit in a process of its own and waits until it has written a checkpoint."""
    running = []

    def start(output: Path, threads: str, until=lambda path: path):
        arguments = (capture, output, tmp_path / "log" / "stderr", threads)
        process = nursery.Process(target=fit_apart, args=arguments)
        (tmp_path / "log").mkdir()
        process.start()
        running.append(process)
        deadline = time.monotonic() + 60
        while not until(output.with_suffix(".fit.ckpt")).exists():
            assert process.is_alive() and time.monotonic() < deadline
            time.sleep(0.002)
        return process

    yield start
    for process in running:
        process.kill()
        process.join()


@pytest.mark.parametrize("delay", KILLED_AFTER)
def test_a_killed_fit_goes_on_to_the_same_bytes(started, capture, whole, tmp_path, delay):
    """On two threads before the kill, and on as many as there are after it."""
    output = tmp_path / "x.cap4d"
    process = started(output, "2")
    time.sleep(delay)
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert not output.exists()
    slow_fit(capture, output, resume=True)
    assert output.read_bytes() == whole
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log", "x.cap4d", "x.fit.json", "x.fit.png"]


def test_ctrl_c_saves_and_says_how_to_go_on(started, capture, whole, tmp_path):
    output = tmp_path / "x.cap4d"
    process = started(output, "1")
    os.kill(process.pid, signal.SIGINT)
    process.join(timeout=60)
    assert process.exitcode == 130
    lines = (tmp_path / "log" / "stderr").read_text().splitlines()
    assert sum("the same command with --resume goes on" in line for line in lines) == 1
    assert not any("Traceback" in line for line in lines)
    slow_fit(capture, output, resume=True)
    assert output.read_bytes() == whole


def test_a_spoiled_checkpoint_costs_some_steps_and_not_the_fit(started, capture, whole, tmp_path, caplog):
    output = tmp_path / "x.cap4d"
    checkpoint = output.with_suffix(".fit.ckpt")
    process = started(output, "1", until=previous_of)
    process.kill()
    process.join()
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
