"""What to do with a file that the user drops, opens or picks."""

from __future__ import annotations

from enum import Enum
from pathlib import Path

from cap4d.errors import ArgumentError


class Use(Enum):
    """What a file is for."""

    AVATAR = "an avatar"
    DRIVE = "what drives it"
    SOUND = "sound"
    BACKGROUND = "a background"


USES = {
    ".cap4d": Use.AVATAR,
    **dict.fromkeys((".npz", ".npy", ".csv"), Use.DRIVE),
    ".wav": Use.SOUND,
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".webp", ".bmp"), Use.BACKGROUND),
}


def use_of(path: Path) -> Use:
    """What a file is for, by its name.

    Raises:
        ArgumentError: It is nothing that the viewer takes.
    """
    use = USES.get(path.suffix.lower())
    if use is None:
        raise ArgumentError(f"{path.name}: expected a file ending in {', '.join(USES)}")
    return use
