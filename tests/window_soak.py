"""Everything that a user may do to a window, round after round: for tests and the bench, under xvfb-run."""

from __future__ import annotations

import time
import wave
from pathlib import Path

import glfw
import numpy as np
from cap4d.app.live import LivePlayer
from cap4d.app.overlays.overlays import Overlay
from cap4d.app.shortcuts import Action
from cap4d.app.toasts import Tone
from real_window import pump, pump_for

from cap4d.player.png import write_png

SIZES = ((1, 1), (3840, 2160), (420, 280), (1, 900), (1180, 760))


def write_droppings(folder: Path, avatar: Path) -> list[Path]:
    """What gets dropped: two avatars' worth of one, a sound, a picture, and what is none of these."""
    write_png(folder / "behind.png", np.full((90, 160, 3), 120, np.uint8))
    with wave.open(str(folder / "tone.wav"), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(16_000)
        file.writeframes((8000 * np.sin(np.arange(32_000) / 20)).astype(np.int16).tobytes())
    (folder / "broken.cap4d").write_bytes(avatar.read_bytes()[:5000])
    (folder / "broken.npz").write_bytes(b"PK\x03\x04 no archive")
    names = ("behind.png", "tone.wav", "broken.cap4d", "broken.npz", "missing.wav", "notes.txt")
    return [avatar, *(folder / name for name in names)]


def soak_round(player: LivePlayer, droppings: list[Path], folder: Path) -> None:
    """One round: every panel, menu and dialog opened and closed, every size, every drop while it records."""
    player.taking.folder = folder
    viewer = player.viewer
    viewer.act(Action.RECORD)
    for panel in player.screen.sidebar.panels:
        player.screen.sidebar.wanted = panel.title
        player.gui.touch()
        pump_for(player, 0.05)
    for overlay in Overlay:
        viewer.overlays = frozenset({overlay})
        pump_for(player, 0.05)
    for action in (
        Action.HELP,
        Action.OPEN,
        Action.CLOSE,
        Action.DRIVE,
        Action.CLOSE,
        Action.SIDEBAR,
        Action.PANELS,
    ):
        viewer.act(action)
        pump_for(player, 0.05)
    viewer.act(Action.SIDEBAR)
    viewer.act(Action.PANELS)
    for size in SIZES:
        glfw.set_window_size(player.window.handle, *size)
        pump_for(player, 0.2)
    for path in droppings:
        player.input.dropped([path])
        pump(player, lambda: viewer.jobs.label is None, 60)
    viewer.act(Action.RANDOM_FACE)
    viewer.act(Action.NEXT_DEFORMER)
    viewer.act(Action.SCREENSHOT)
    pump(player, lambda: viewer.jobs.label is None, 60)
    viewer.act(Action.RESET_FACE)
    viewer.act(Action.RECORD)
    pump(player, lambda: player.taking.recorder is None and viewer.jobs.label is None, 60)
    viewer.set_sound(None)
    viewer.overlays = frozenset()
    viewer.background = (1.0, 1.0, 1.0)


def errors_said(player: LivePlayer) -> list[str]:
    """The errors on screen."""
    viewer = player.viewer
    return [t.text for t in viewer.toasts.current(viewer.now) if t.tone is Tone.ERROR]


def resident_mb() -> float:
    """Memory that the process holds now, MB (Linux)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("no VmRSS")


def soak(player: LivePlayer, avatar: Path, folder: Path, seconds: float) -> list[float]:
    """Rounds until `seconds` are over, two at least; the memory after each, MB."""
    droppings, memory = write_droppings(folder, avatar), []
    end = time.monotonic() + seconds
    while len(memory) < 2 or time.monotonic() < end:
        soak_round(player, droppings, folder)
        for made in (*folder.glob("*_0*.png"), *folder.glob("*.mp4")):
            made.unlink()
        player.window.ctx.gc()
        memory.append(resident_mb())
    return memory
