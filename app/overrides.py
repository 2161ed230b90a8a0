"""What the user's hand holds against what plays: expressions and rotations, each until it is let go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cap4d.camera import head_fixed
from cap4d.drive.clip import Frame
from cap4d.rotation import axis_angle_to_rotmat

FRAME_TURNS = ("eye_rot", "neck_rot", "jaw_rot")
HEAD = "head"  # turns the whole head: the camera's business
RANDOM_SHARE = 0.3  # of the expressions that take part in a random face


class Overrides:
    """A layer over a playing frame. An expression that is touched stays where it was put until it is reset.

    Args:
        ranges: float32[E, 2] the useful values of each expression; further out nothing can be put.
    """

    def __init__(self, ranges: np.ndarray) -> None:
        self.ranges = np.asarray(ranges, np.float32)
        self.held = np.zeros(len(self.ranges), bool)
        self.values = np.zeros(len(self.ranges), np.float32)
        self.turns: dict[str, np.ndarray] = {}
        self.version = 0  # grows with every change

    @property
    def count(self) -> int:
        """How many expressions and rotations are held."""
        return int(self.held.sum()) + len(self.turns)

    def hold(self, index: int, value: float) -> None:
        """Puts expression `index` to `value`, within its range."""
        low, high = self.ranges[index]
        self.held[index] = True
        self.values[index] = np.clip(value, low, high)
        self.version += 1

    def hold_turn(self, name: str, turn: np.ndarray) -> None:
        """Puts a rotation, one of `FRAME_TURNS` or `HEAD`, to `turn`, [3] axis-angle, rad."""
        self.turns[name] = np.asarray(turn, np.float32)
        self.version += 1

    def let_go(self, index: int) -> None:
        """Expression `index` plays again."""
        self.held[index] = False
        self.version += 1

    def let_turn_go(self, name: str) -> None:
        """The rotation plays again."""
        if self.turns.pop(name, None) is not None:
            self.version += 1

    def reset(self) -> None:
        """Everything plays again."""
        self.held[:] = False
        self.turns.clear()
        self.version += 1

    def neutral(self) -> None:
        """Holds every expression at 0, or as near to it as its range goes."""
        self.held[:] = True
        self.values = np.clip(0, *self.ranges.T).astype(np.float32)
        self.version += 1

    def randomize(self, generator: np.random.Generator) -> None:
        """Holds a random face: a third of the expressions move, few of them far."""
        low, high = self.ranges.T
        count = len(self.ranges)
        taking_part = generator.uniform(size=count) < RANDOM_SHARE
        taking_part[generator.integers(count)] = True  # a rig of few expressions shows something, too
        amount = generator.beta(1.2, 2.5, size=count) * taking_part
        towards = np.where((generator.uniform(size=count) < 0.5) & (low < 0), low, high)
        self.held[:] = True
        self.values = np.clip(amount * towards, low, high).astype(np.float32)
        self.version += 1

    def apply(self, frame: Frame) -> Frame:
        """The frame with what is held put into it."""
        if not self.count:
            return frame
        expr = np.where(self.held, self.values, frame.expr).astype(np.float32)
        return replace(frame, expr=expr, **{n: t for n, t in self.turns.items() if n in FRAME_TURNS})

    def turned(self, viewmat: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """The camera that sees the head turned about its middle, `centre` [3] m.

        Args:
            viewmat: [4, 4] view from head.
        """
        if HEAD not in self.turns:
            return viewmat
        rig_centre = centre * (1, -1, -1)
        rotated = axis_angle_to_rotmat(self.turns[HEAD].astype(np.float64)) @ rig_centre
        return head_fixed(viewmat, self.turns[HEAD], rig_centre - rotated)
