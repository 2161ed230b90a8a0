"""Photos and video to captures."""

from cap4d.track.tracker import TrackReport, track

__all__ = ["TrackReport", "track"]
