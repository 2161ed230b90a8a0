"""The demo: an avatar of the built-in head, fitted once and kept, or one made from a video; then played."""

from __future__ import annotations

import hashlib
import logging
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from cap4d import __version__
from cap4d.errors import ArgumentError
from cap4d.rig.head import HeadRig

log = logging.getLogger(__name__)

SEED = 0
VIEWS, FRAMES, SIZE = 10, 60, 256


def demo_avatar_path() -> Path:
    """The demo's `.cap4d`, fitted to a synthetic capture of the built-in head the first time it is asked for.

    Raises:
        ArgumentError: It is not there yet and the packages that fit avatars are not installed.
    """
    from cap4d.rig.builtin import build_head

    rig = build_head()
    path = cache_folder() / f"demo-{__version__}-{fingerprint(rig)}.cap4d"
    if not path.exists():
        build_demo_avatar(rig, path)
    return path


def build_demo_avatar(rig: HeadRig, path: Path) -> None:
    """Synthesises a capture of `rig`, fits an avatar to it (preset `debug`) and writes it to `path`."""
    try:
        from cap4d.avatar.fit import fit
        from cap4d.synth.capture import synthesize
    except ImportError as error:
        raise ArgumentError(
            f"the demo avatar is built once, which needs the extra cap4d[fit] ({error})"
        ) from error
    log.info("building the demo avatar (once, a few minutes): %s", path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as folder:
        capture = Path(folder) / "capture"
        synthesize(rig, capture, views=VIEWS, frames=FRAMES, size=SIZE, seed=SEED)
        fit([capture], rig, path, preset="debug", seed=SEED)


def avatar_from_video(video: Path, rig: HeadRig, folder: Path, *, preset: str) -> Path:
    """The whole road: video -> capture -> avatar, kept in `folder` made once."""
    from cap4d.avatar.fit import fit
    from cap4d.track import track

    folder.mkdir(parents=True, exist_ok=True)
    capture, avatar = folder / f"{video.stem}.capture", folder / f"{video.stem}.cap4d"
    if not capture.exists():
        track(video, rig, capture)
    if not avatar.exists():
        fit([capture], rig, avatar, preset=preset, seed=SEED)
    return avatar


def play(avatar: Path, folder: Path) -> int:
    """Opens the viewer; without a display it renders `demo.mp4` and `demo.png` into `folder` instead."""
    view = [sys.executable, "-m", "cap4d.app.main", str(avatar)]
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform in ("darwin", "win32"):
        return subprocess.call(view)
    folder.mkdir(parents=True, exist_ok=True)
    code = subprocess.call([*view, "--headless", "--camera", "orbit", "--out", str(folder / "demo.mp4")])
    return code or subprocess.call([*view, "--headless", "--frames", "1", "--out", str(folder / "demo.png")])


def cache_folder() -> Path:
    """Where the demo avatar is kept: the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cap4d"


def fingerprint(rig: HeadRig) -> str:
    """Eight hex digits that change with the built-in head, so that a stale demo is never played."""
    digest = hashlib.sha256()
    for array in (rig.template, rig.expression_basis, rig.uvs, rig.colors):
        digest.update(array.tobytes())
    return digest.hexdigest()[:8]
