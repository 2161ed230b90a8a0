"""cap4d: photos or a video of a person in, a live 4D avatar out. Importing it never imports torch."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cap4d.errors import ArgumentError, Cap4dError, DataError

if TYPE_CHECKING:
    from cap4d.camera import Camera
    from cap4d.drive.open_live import open_live
    from cap4d.gaussians import Gaussians
    from cap4d.player.avatar import Avatar

__version__ = "0.1.0"
__all__ = [
    "ArgumentError",
    "Avatar",
    "Camera",
    "Cap4dError",
    "DataError",
    "Gaussians",
    "__version__",
    "open_live",
]

# Imported when first asked for: programs choose NumPy's threads before it loads.
LAZY = {
    "Avatar": "cap4d.player.avatar",
    "Camera": "cap4d.camera",
    "Gaussians": "cap4d.gaussians",
    "open_live": "cap4d.drive.open_live",
}


def __getattr__(name: str) -> Any:
    if name in LAZY:
        return getattr(import_module(LAZY[name]), name)
    raise AttributeError(f"module 'cap4d' has no attribute {name!r}")
