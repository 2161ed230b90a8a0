"""A sound beside what plays: it does what the clip does, and while it plays its clock rules."""

from __future__ import annotations

from cap4d.app.playback import ClipPlayback, Playback
from cap4d.app.sound import SoundPlayer


class Accompaniment:
    """Follows the user's hand on a clip; beside a live stream it just plays.

    Args:
        player: Paused at 0; closed with the accompaniment.
    """

    def __init__(self, player: SoundPlayer) -> None:
        self.player = player
        self._heard: tuple[ClipPlayback, int] | None = None  # which clip, and its moves as last seen

    def follow(self, playback: Playback, now: float) -> None:
        """Called for every picture."""
        if not isinstance(playback, ClipPlayback):
            self.player.play()
            return
        self.player.loop = playback.clip.duration if playback.loops else None
        if self.player.speed != playback.speed:
            self.player.speed = playback.speed
        if self._heard != (playback, playback.moves):
            self._heard = playback, playback.moves
            self.player.seek(playback.position)
        if playback.is_paused:
            self.player.pause()
            return
        self.player.play()
        playback.follow(self.player.position(), now)

    def close(self) -> None:
        """Ends the sound."""
        self.player.close()
