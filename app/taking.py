"""Screenshots and recordings of a viewer: where they go, and what is in them."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import numpy as np
from cap4d.app.background import Background, Checkerboard
from cap4d.app.recorder import Recorder
from cap4d.app.screenshot import free_path, save_screenshot, straight
from cap4d.app.viewer import Viewer

RECORDING_FPS = 30.0


class Taking:
    """Takes pictures of what a viewer shows, into the folder of the program's start, or the user's own.

    Args:
        viewer: Hears what became of it.
        folder: Another place.
    """

    def __init__(self, viewer: Viewer, folder: Path | None = None) -> None:
        self.viewer = viewer
        self.folder = folder or _writable_folder()
        self.recorder: Recorder | None = None

    def behind(self, background: Background) -> Background:
        """What is behind the avatar in a screenshot: nothing where a checkerboard stands for it."""
        return None if isinstance(background, Checkerboard) else background

    def screenshot(self, image: np.ndarray, *, is_transparent: bool) -> None:
        """Saves a picture in the background.

        Args:
            image: uint8[H, W, 4], premultiplied if `is_transparent`.
        """
        viewer, folder, name = self.viewer, self.folder, self.viewer.loaded.path.stem

        def save() -> Path:
            return save_screenshot(folder, straight(image) if is_transparent else image[..., :3], name=name)

        viewer.jobs.start("Saving a picture", save, lambda path: viewer.say(f"Saved {path}"))

    def toggle_recording(self, size: tuple[int, int]) -> None:
        """Starts an mp4 of about `size` px, or ends it."""
        if self.recorder is not None:
            self.stop_recording()
            return
        viewer = self.viewer
        try:
            path = free_path(self.folder, viewer.loaded.path.stem, ".mp4")
            sound = viewer.accompaniment.player if viewer.accompaniment is not None else None
            self.recorder = Recorder(
                path,
                _even(size),
                RECORDING_FPS,
                None if sound is None else sound.sound,
                sound_at=None if sound is None else sound.heard,
            )
            viewer.recording_since = viewer.now
        except Exception as error:  # a folder that is gone, a disk that is full
            viewer.fail(error)

    def add(self, image: np.ndarray) -> None:
        """A picture was shown: uint8[H, W, 4]."""
        if self.recorder is None:
            return
        self.recorder.add(image, self.viewer.now)
        if self.recorder.error is not None:
            self.stop_recording()

    def stop_recording(self) -> None:
        """Finishes the file in the background."""
        recorder, viewer = self.recorder, self.viewer
        self.recorder = viewer.recording_since = None
        if recorder is not None:
            finished = partial(_tell, viewer, recorder)
            viewer.jobs.start("Finishing the recording", recorder.close, finished, must_be_done=True)

    def close(self) -> None:
        """Finishes a recording that still runs, before the program ends."""
        if self.recorder is not None:
            self.recorder.close()
            self.recorder = None


def _tell(viewer: Viewer, recorder: Recorder, _: object) -> None:
    viewer.say(f"Saved {recorder.path}" if recorder.frames else "Nothing was recorded")


def _even(size: tuple[int, int]) -> tuple[int, int]:
    """An mp4's sides are even."""
    return max(size[0] // 2 * 2, 2), max(size[1] // 2 * 2, 2)


def _writable_folder() -> Path:
    here = Path.cwd()
    return here if os.access(here, os.W_OK) and here != Path(here.anchor) else Path.home()
