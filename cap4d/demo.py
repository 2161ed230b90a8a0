"""The demo: an avatar of the built-in head, fitted once and kept, or one made from a video; then played."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from cap4d import __version__
from cap4d.atomic import replacing
from cap4d.errors import ArgumentError
from cap4d.rig.head import HeadRig

log = logging.getLogger(__name__)

SEED = 0
VIEWS, FRAMES, SIZE = 11, 60, 256  # two of the views from behind, of nine in front the fifth looks straight
DEMO_RECORD = "demo.json"  # in the cache folder: which code makes which avatar
DEMO_NAME = re.compile(r"demo-[\w.-]+\.cap4d")
EDITION = 2  # of the avatars made here: counts up when they come out otherwise from the same material


def demo_avatar_path() -> Path:
    """The demo's `.cap4d`, fitted to a synthetic capture of the built-in head the first time it is asked for.

    Raises:
        ModuleNotFoundError: It is not there yet and the packages that fit avatars are not installed.
    """
    known = remembered_demo()
    if known is not None:
        return known
    from cap4d.rig.builtin import build_head

    rig = build_head()
    key = fingerprint(VIEWS, FRAMES, SIZE, *rig_facts(rig))
    path = cache_folder() / f"demo-{__version__}-{key}.cap4d"
    if not path.exists():
        build_demo_avatar(rig, path)
    remember_demo(path)
    return path


def remembered_demo() -> Path | None:
    """The demo's avatar, if it is known which one this code makes: building the head to find out takes most of
    a second.
    """
    try:
        code, name = json.loads((cache_folder() / DEMO_RECORD).read_text("utf-8")[:1000])
    except (OSError, ValueError, TypeError):
        return None
    if code != code_fingerprint() or not isinstance(name, str) or not DEMO_NAME.fullmatch(name):
        return None
    path = cache_folder() / name
    return path if path.is_file() else None


def remember_demo(path: Path) -> None:
    """Notes which avatar this code makes."""
    try:
        with replacing(cache_folder() / DEMO_RECORD) as temporary:
            temporary.write_text(json.dumps([code_fingerprint(), path.name]))
    except (ArgumentError, OSError) as error:
        log.debug("%s is looked for anew each time: %s", path, error)


def code_fingerprint() -> str:
    """Changes with any line of code that can change the built-in head, and with NumPy."""
    here = Path(__file__).parent
    files = sorted([*here.glob("*.py"), *(here / "rig").rglob("*.py")])
    digest = hashlib.sha256(repr((fingerprint(VIEWS, FRAMES, SIZE), np.__version__)).encode())
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def build_demo_avatar(rig: HeadRig, path: Path) -> None:
    """Synthesises a capture of `rig`, fits an avatar to it (preset `debug`) and writes it to `path`."""
    from cap4d.avatar.fit import fit
    from cap4d.synth.capture import synthesize

    log.info("building the demo avatar (once, a few minutes): %s", path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as folder:
        capture = Path(folder) / "capture"
        synthesize(rig, capture, views=VIEWS, frames=FRAMES, size=SIZE, seed=SEED)
        fit([capture], rig, path, preset="debug", seed=SEED)


def avatar_from_video(video: Path, rig: HeadRig, folder: Path, *, preset: str) -> Path:
    """The whole road: video -> capture -> avatar, kept in `folder`, each made once.

    File names carry a fingerprint of what they are made from, so that another video, head model or preset
    never meets the files of this one; an interrupted fit goes on where it was.

    Raises:
        ArgumentError: There is no such video.
    """
    if not video.exists():
        raise ArgumentError(f"video: expected a video, found nothing at {video}")
    from cap4d.avatar.fit import fit
    from cap4d.track import track

    folder.mkdir(parents=True, exist_ok=True)
    tracked = (*file_facts(video), *rig_facts(rig))
    capture = folder / f"{video.stem}-{fingerprint(*tracked)}.capture"
    avatar = folder / f"{video.stem}-{preset}-{fingerprint(*tracked, preset)}.cap4d"
    if not capture.exists():
        track(video, rig, capture)
    if not avatar.exists():
        fit([capture], rig, avatar, preset=preset, resume=True, seed=SEED)
    return avatar


def play(avatar: Path, folder: Path) -> int:
    """Opens the viewer; without a display it renders `demo.mp4` and `demo.png` into `folder` instead."""
    view = [sys.executable, "-m", "cap4d.app.main", str(avatar)]
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform in ("darwin", "win32"):
        return subprocess.call(view)
    folder.mkdir(parents=True, exist_ok=True)
    film = [*view, "--headless", "--camera", "orbit", "--out", str(folder / "demo.mp4")]
    # The idle clip begins awake and at rest, and the avatar's own camera looks it in the face.
    photo = [*view, "--headless", "--camera", "static", "--frames", "1", "--out", str(folder / "demo.png")]
    return subprocess.call(film) or subprocess.call(photo)


def cache_folder() -> Path:
    """Where the demo avatar is kept: the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cap4d"


def fingerprint(*facts: object) -> str:
    """Eight hex digits that change with the facts, the version or the edition: nothing stale is played."""
    return hashlib.sha256(repr((__version__, EDITION, SEED, *facts)).encode()).hexdigest()[:8]


def file_facts(path: Path) -> tuple[object, ...]:
    """Which file it is, and whether it changed."""
    found = path.stat()
    return str(path.resolve()), found.st_size, found.st_mtime_ns


def rig_facts(rig: HeadRig) -> tuple[object, ...]:
    """Which head model it is, down to its numbers."""
    arrays = (rig.template, rig.faces, rig.identity_basis, rig.expression_basis, rig.uvs, rig.colors)
    digest = hashlib.sha256()
    for array in arrays:
        if array is not None:
            digest.update(np.ascontiguousarray(array))
    return rig.name, [None if a is None else a.shape for a in arrays], digest.hexdigest()
