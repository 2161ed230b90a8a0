"""What a live frame costs before it can be posed: parsing, converting, filling in. One thread.

python -m pytest -m bench -s tests/bench/bench_drive_convert.py
"""

from __future__ import annotations

import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cap4d.bundle import Bundle
from cap4d.drive.arkit import NAMES
from cap4d.drive.convert import Converter
from cap4d.drive.fillers import Fillers
from cap4d.drive.livelink import parse_livelink
from cap4d.drive.packet import Packet
from cap4d.rig.head import HeadRig

pytestmark = pytest.mark.bench
ROUNDS = 200
VERTICES = 5023
BUDGET_MS = 2.0  # of one frame of vertices


@pytest.fixture(scope="module")
def standin(shared: Path) -> tuple[HeadRig, Bundle]:
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from drive_bundle import on_rig

    from cap4d.rig.flame import import_flame

    rig = import_flame(shared / "flame/flame_standin.pkl", shared / "flame/cap4d_assets")
    return rig, on_rig(rig)


def measure(name: str, call: Callable[[int], object]) -> float:
    """ms, the median."""
    call(0)
    seconds = []
    for i in range(ROUNDS):
        start = time.perf_counter()
        call(i)
        seconds.append(time.perf_counter() - start)
    ms = 1e3 * np.array(seconds)
    print(f"{name}: {np.median(ms):.2f} ms (median), {np.percentile(ms, 95):.2f} ms (95th percentile)")
    return float(np.median(ms))


def test_vertices_of_a_speech_model(standin: tuple[HeadRig, Bundle], shared: Path) -> None:
    _, bundle = standin
    truth = np.load(shared / "flame/codetalker/truth.npz")
    files = (shared / "flame/codetalker").glob("cond*.npy")
    frames = np.load(next(files)).reshape(-1, VERTICES, 3).astype(np.float32)
    convert = Converter(bundle, template=truth["template"].astype(np.float32))
    ms = measure("5023 vertices", lambda i: convert(Packet(i, vertices=frames[i % len(frames)])))
    found = np.array([convert(Packet(0, vertices=frame)).expr for frame in frames])
    error = np.sqrt(((found - truth["expr"]) ** 2).mean())
    print(f"expression error {error:.5f} of a spread of {truth['expr'].std():.3f} (root mean square)")
    assert error < 0.003 * truth["expr"].std() and ms < BUDGET_MS


def test_vertices_whose_eyes_turn(standin: tuple[HeadRig, Bundle], shared: Path) -> None:
    rig, bundle = standin
    clip = np.load(shared / "flame/sequence_00/fit.npz")
    expr, gaze = (clip[name][:60].astype(np.float32) for name in ("expr", "eye_rot"))
    mesh = rig.subject()
    frames = np.ascontiguousarray(mesh.pose(expr, eye_rot=gaze)[:, :VERTICES])
    convert = Converter(bundle, template=mesh.pose(0 * expr[0])[:VERTICES])
    ms = measure("5023 vertices with gaze", lambda i: convert(Packet(i, vertices=frames[i % 60])))
    found = convert(Packet(0, vertices=frames[30]))
    assert np.abs(found.expr - expr[30]).max() < 0.05 and np.abs(found.eye_rot - gaze[30]).max() < 1e-3
    assert ms < BUDGET_MS


def test_a_phones_packet_and_what_is_filled_in(standin: tuple[HeadRig, Bundle]) -> None:
    _, bundle = standin
    words = b"".join(struct.pack(">I", len(word)) + word for word in (b"x" * 36, b"iPhone"))
    values = struct.pack(">61f", *np.linspace(0, 1, 61))
    data = b"\x06" + words + struct.pack(">ifii", 100, 0.5, 60, 1) + b"\x3d" + values
    convert, fill = Converter(bundle), Fillers(bundle)
    start = time.perf_counter()
    rest = convert.neutral()
    print(f"ARKit fitted to FLAME in {time.perf_counter() - start:.2f} s, once")
    measure("Live Link Face, parsed and converted", lambda _: convert(parse_livelink(data)))
    ms = measure("blink, gaze and neck filled in", lambda i: fill(rest, i / 60))
    assert parse_livelink(data).arkit.shape == (len(NAMES),) and ms < 1
