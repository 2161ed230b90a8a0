"""cap4d: photos or a video of a person in, a live 4D avatar out. Importing it never imports torch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cap4d.camera import Camera
from cap4d.errors import ArgumentError, Cap4dError, DataError
from cap4d.gaussians import Gaussians

if TYPE_CHECKING:
    from cap4d.player.avatar import Avatar

__version__ = "0.1.0"
__all__ = ["ArgumentError", "Avatar", "Camera", "Cap4dError", "DataError", "Gaussians", "__version__"]


def __getattr__(name: str) -> Any:
    if name == "Avatar":  # onnxruntime takes 0.2 s to import: only those who play pay
        from cap4d.player.avatar import Avatar

        return Avatar
    raise AttributeError(f"module 'cap4d' has no attribute {name!r}")
