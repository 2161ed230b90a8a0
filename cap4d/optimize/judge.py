"""Holds the full avatar's pictures and says how far a candidate is from them."""

from __future__ import annotations

from cap4d.bundle.bundle import Bundle
from cap4d.capture.capture import Capture
from cap4d.optimize.candidate import Candidate
from cap4d.optimize.measure import Error, measure
from cap4d.optimize.oracle import exact_pictures
from cap4d.optimize.scene import Scene, full_pictures, make_scene
from cap4d.optimize.shots import choose_shots
from cap4d.player.avatar import Avatar


class Judge:
    """Looks at candidates.

    Args:
        bundle: The full avatar.
        capture: Its training views count too.
    """

    def __init__(self, bundle: Bundle, capture: Capture | None = None) -> None:
        avatar = Avatar(bundle, deformer=bundle.tiers[0])
        self.shots = choose_shots(avatar, capture)
        self._exact = exact_pictures(bundle, self.shots.measured, "float64 pictures")
        self._beyond = full_pictures(avatar, self.shots.beyond)
        self._learned = full_pictures(avatar, self.shots.learned)

    def error(self, candidate: Candidate) -> Error:
        """On the measured shots, against float64."""
        return measure(candidate.avatar(), self.shots.measured, self._exact)

    def error_beyond(self, candidate: Candidate) -> Error:
        """On expressions that the avatar's clip does not show, against the full avatar in float32."""
        return measure(candidate.avatar(), self.shots.beyond, self._beyond)

    def scene(self, candidate: Candidate) -> Scene:
        """What steps learn from, with the candidate's own surface."""
        return make_scene(candidate.avatar(), self.shots.learned, self._learned)
