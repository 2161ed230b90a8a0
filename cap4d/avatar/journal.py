"""A fit's memory of itself: its checkpoints, and the time spent on it in this process and before."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from cap4d.avatar.checkpoint import load_latest, remove_checkpoints, save_checkpoint
from cap4d.avatar.trainer import Trainer
from cap4d.errors import DataError

log = logging.getLogger(__name__)

FOREIGN = (
    AttributeError,
    IndexError,
    KeyError,
    RuntimeError,
    TypeError,
    ValueError,
)  # of a state that is none


class Journal:
    """The checkpoints of one fit.

    Args:
        path: `.fit.ckpt` file.
        kind: What tells this fit from others: one of another kind is not gone on with.
        started: `time.monotonic()` of the fit's beginning.
    """

    def __init__(self, path: Path, *, kind: str, started: float) -> None:
        self.path, self.kind, self._started = path, kind, started
        self._spent = 0.0

    def seconds(self) -> float:
        """Wall time of the fit so far, with that of the processes it goes on from."""
        return self._spent + time.monotonic() - self._started

    def save(self, trainer: Trainer) -> None:
        """Writes a checkpoint, whole or not at all."""
        state = {"kind": self.kind, "trainer": trainer.state(), "seconds": self.seconds()}
        save_checkpoint(state, self.path)

    def take_up(self, trainer: Trainer) -> None:
        """Puts the trainer where the newest whole checkpoint left it, if there is one.

        Raises:
            DataError: All there are are spoiled, or it is one of another fit.
        """
        state = load_latest(self.path, kind=self.kind)
        if state is None:
            return
        try:
            trainer.restore(state["trainer"])
            self._spent = float(state["seconds"])
        except FOREIGN as error:
            found = f"{type(error).__name__}: {error}"[:200]
            raise DataError(self.path, "state", expected="that of this fit", found=found) from error
        log.info("%s: going on at step %d", self.path, trainer.step)

    def close(self) -> None:
        """Removes the checkpoints: the fit is over."""
        remove_checkpoints(self.path)
