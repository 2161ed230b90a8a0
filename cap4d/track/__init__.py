"""Photos and video to captures."""

from __future__ import annotations

from typing import Any

__all__ = ["TrackReport", "track"]


def __getattr__(name: str) -> Any:
    """The tracker needs torch; who asks for landmarks alone does not wait for it."""
    if name in __all__:
        from cap4d.track import tracker

        return getattr(tracker, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
