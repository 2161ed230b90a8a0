"""What keeps a face alive that its source leaves still: blinks, glances, a neck that breathes.

Each acts only on what the source lacks, fades out while the source moves that by itself, and comes back when
it has not for a while. What they do at a moment is a function of that moment and the seed alone: no frame
rate changes it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.drive.arkit import COLUMN, ArkitMap, apple_name, arkit_map, look_weights
from cap4d.drive.clip import Frame
from cap4d.errors import ArgumentError

# Blinks: 17 a minute at rest (Bentivoglio et al. 1997). Lids fall in about 100 ms and rise in about twice
# that, ever slower (Guitton, Simard and Codere 1991; VanderWerf et al. 2003; Trutoiu et al. 2011).
BLINK_SECONDS = 3.5  # between blinks, on average
LIDS_FALL, LIDS_SHUT, LIDS_RISE = 0.13, 0.03, 0.26  # s, of a blink of ordinary speed
BLINK_SPEED = (0.85, 1.2)  # how much faster or slower one is

# Glances: a saccade of A degrees lasts 21 ms + 2.2 ms/deg (the main sequence; Carpenter 1988); their sizes
# and directions are those of people in talk (Lee, Badler and Badler 2002, "Eyes Alive"): A = -6.9 log(P /
# 15.7), P uniform in per cent; sideways and up or down more often than aslant. Most look at the partner, with
# small shifts about him.
GLANCE_SECONDS = 0.9  # between saccades, on average
SACCADE_SECONDS, SACCADE_SECONDS_PER_DEG = 0.021, 0.0022
GLANCE_SCALE, GLANCE_ODDS = 6.9, 15.7
MAX_GLANCE_DEG = 12.0
AWAY = 0.25  # share of saccades that leave the partner
SHIFT_DEG = 1.2  # spread of those that stay
DIRECTIONS = (
    np.cumsum([15.54, 6.46, 17.69, 7.44, 16.80, 7.89, 20.38, 7.80]) / 100
)  # every 45 degrees from the right

# The neck: 15 breaths a minute, and the slow sway of a head that is held up by muscles.
BREATH_SECONDS, BREATH_DEG = 4.0, 0.5
SWAY_SECONDS, SWAY_DEG = (7.3, 11.9), (0.5, 0.9, 0.4)  # about x, y, z

QUIET_SECONDS = 10.0  # of a source that moved something itself, before it is taken for lacking it
RISE_SECONDS, FALL_SECONDS = 1.0, 0.15
LID_MOTION, GAZE_MOTION, NECK_MOTION = 0.1, 0.01, 0.01  # weight, rad, rad: less is noise
LID_SHAPES = ("eyeBlink", "eyeWide", "eyeSquint", "eyeLookDown", "eyeLookUp")


class Fillers:
    """Frames in, frames out; for one thread at a time.

    Args:
        bundle: The avatar. Blinks need a rig that has one: by name, or FLAME, whose expressions can make one.
        blink, gaze, neck: Which fillers there are.
        seed: Of everything that looks like chance.
    """

    def __init__(
        self, bundle: Bundle, *, blink: bool = True, gaze: bool = True, neck: bool = True, seed: int = 0
    ) -> None:
        arkit = _arkit_of(bundle)
        self._lids = lids_of(bundle) if blink else None
        self._looks = arkit if arkit is not None and not arkit.error_mm.any() else None
        self._seed = seed
        self._start: float | None = None
        self._last: float | None = None
        self._lack = {"neck": _Lack(NECK_MOTION)} if neck else {}
        if gaze and "eyes" in bundle.subject.joint_drivers:
            self._lack["gaze"] = _Lack(GAZE_MOTION)
        if self._lids is not None:
            self._lack["blink"] = _Lack(LID_MOTION)

    def __call__(self, frame: Frame, now: float) -> Frame:
        """The frame with what it lacks.

        Args:
            frame: What the source says; it is not written to.
            now: s of a clock that runs on while the source is silent.
        """
        if not np.isfinite(now):
            return frame
        self._start = now if self._start is None else self._start
        elapsed = 0.0 if self._last is None else min(max(now - self._last, 0.0), 1.0)
        self._last, t = now, now - self._start
        changes: dict[str, np.ndarray] = {}
        for name, lack in self._lack.items():
            share = lack.share(self._source(name, frame), now, elapsed)
            if share > 0:
                changes = getattr(self, f"_{name}")(frame, changes, t, share)
        return replace(frame, **changes) if changes else frame

    def _source(self, name: str, frame: Frame) -> np.ndarray:
        """What of the frame says whether the source has this itself."""
        if name == "blink":
            return self._lids.signal @ frame.expr
        if name == "gaze":
            return frame.eye_rot
        return frame.neck_rot if frame.rot is None else np.concatenate([frame.neck_rot, frame.rot])

    def _neck(self, frame: Frame, changes: dict, t: float, share: float) -> dict:
        return {**changes, "neck_rot": frame.neck_rot + np.float32(share) * sway_at(t, self._seed)}

    def _gaze(self, frame: Frame, changes: dict, t: float, share: float) -> dict:
        glance = np.float32(share) * glance_at(t, self._seed)
        changes = {**changes, "eye_rot": frame.eye_rot + glance}
        if self._looks is not None:  # the lids go with the eyes
            changes["expr"] = changes.get("expr", frame.expr) + self._looks.expr @ look_weights(glance)
        return changes

    def _blink(self, frame: Frame, changes: dict, t: float, share: float) -> dict:
        shut = np.float32(share * lid_closure(t, self._seed))
        if shut <= 0:
            return changes
        expr, lids = changes.get("expr", frame.expr), self._lids
        return {**changes, "expr": expr + shut * (lids.closed - lids.replaced * expr)}


@dataclass(frozen=True, eq=False)
class Lids:
    """How a rig blinks: expr + shut (closed - replaced expr), so that lids meet wherever they were.

    Args:
        closed: float32[E] what shuts both eyes.
        replaced: float32[E] 1 for expressions of the lids, which a blink overrules; else 0.
        signal: float32[K, E] maps expressions to how far the source itself has its lids shut.
    """

    closed: np.ndarray
    replaced: np.ndarray
    signal: np.ndarray


def lids_of(bundle: Bundle) -> Lids | None:
    """By the names of the rig's expressions: Apple's, or a `blink`; else from its basis, as `arkit_map`
    solves it; None for a rig with neither.
    """
    names, arkit = bundle.subject.expression_names, _arkit_of(bundle)
    if "blink" in names:
        closed = np.float32([name == "blink" for name in names])
        return Lids(closed, closed, closed[None])
    apple = [apple_name(name) or "" for name in names]
    if any(name.startswith("eyeBlink") for name in apple):
        closed = np.float32([name.startswith("eyeBlink") for name in apple])
        lids = np.float32([name.startswith(LID_SHAPES) for name in apple])
        return Lids(closed, lids, np.eye(len(names), dtype=np.float32)[closed > 0])
    if arkit is None:
        return None
    closed = arkit.expr[:, COLUMN["eyeBlinkLeft"]] + arkit.expr[:, COLUMN["eyeBlinkRight"]]
    strength = float(closed @ closed)
    return Lids(closed, 0 * closed, closed[None] / strength) if strength > 0 else None


def lid_closure(t: float, seed: int) -> float:
    """0 open to 1 shut, at `t` s: one blink somewhere in every `BLINK_SECONDS`."""
    cell = int(np.floor(t / BLINK_SECONDS))
    return max(_one_blink(t, at, speed) for at, speed in (_blink(seed, cell - 1), _blink(seed, cell)))


def glance_at(t: float, seed: int) -> np.ndarray:
    """float32[3] rad, where the eyes rest or how far a saccade has come, at `t` s."""
    cell = int(np.floor(t / GLANCE_SECONDS))
    if t < _glance(seed, cell)[0]:
        cell -= 1
    start, target = _glance(seed, cell)
    origin = _glance(seed, cell - 1)[1]
    degrees = float(np.degrees(np.linalg.norm(target - origin)))
    duration = SACCADE_SECONDS + SACCADE_SECONDS_PER_DEG * degrees
    return (origin + _minimum_jerk((t - start) / duration) * (target - origin)).astype(np.float32)


def sway_at(t: float, seed: int) -> np.ndarray:
    """float32[3] rad of the neck at `t` s: breath about x, two slow waves about each axis."""
    phases = _chance(seed, 0, "sway").uniform(0, 2 * np.pi, (len(SWAY_SECONDS), 3))
    waves = np.sin(2 * np.pi * t / np.array(SWAY_SECONDS)[:, None] + phases).mean(0)
    degrees = np.array(SWAY_DEG) * waves
    degrees[0] += BREATH_DEG * np.sin(2 * np.pi * t / BREATH_SECONDS)
    return np.radians(degrees).astype(np.float32)


class _Lack:
    """How far a filler stands in: 1 where the source has kept still, 0 where it has moved lately."""

    def __init__(self, motion: float) -> None:
        self._motion, self._share = motion, 0.0
        self._reference: np.ndarray | None = None
        self._moved: float | None = None

    def share(self, value: np.ndarray, now: float, elapsed: float) -> float:
        if self._reference is None or self._reference.shape != value.shape:
            self._reference = value
        elif np.abs(value - self._reference).max() > self._motion:
            self._reference, self._moved = value, now
        quiet = self._moved is None or not 0 <= now - self._moved < QUIET_SECONDS
        step = elapsed / RISE_SECONDS if quiet else -elapsed / FALL_SECONDS
        self._share = min(max(self._share + step, 0.0), 1.0)
        return self._share


def _arkit_of(bundle: Bundle) -> ArkitMap | None:
    try:
        return arkit_map(bundle)
    except ArgumentError:
        return None


def _one_blink(t: float, at: float, speed: float) -> float:
    """Lids fall smoothly and rise ever slower."""
    since = (t - at) * speed
    if since <= 0:
        return 0.0
    if since < LIDS_FALL:
        return _minimum_jerk(since / LIDS_FALL)
    rising = (since - LIDS_FALL - LIDS_SHUT) / LIDS_RISE
    if rising >= 1:
        return 0.0
    return 1.0 if rising <= 0 else 1 - _minimum_jerk(1 - (1 - rising) ** 1.6)


def _minimum_jerk(x: float) -> float:
    """0 to 1 with no speed or acceleration at either end (Flash and Hogan 1985)."""
    x = min(max(x, 0.0), 1.0)
    return x * x * x * (10 + x * (6 * x - 15))


@lru_cache(maxsize=64)
def _blink(seed: int, cell: int) -> tuple[float, float]:
    """When the blink of a stretch of time begins, s, and its speed."""
    chance = _chance(seed, cell, "blink")
    return (cell + chance.uniform()) * BLINK_SECONDS, chance.uniform(*BLINK_SPEED)


@lru_cache(maxsize=64)
def _glance(seed: int, cell: int) -> tuple[float, np.ndarray]:
    """When the saccade of a stretch of time begins, s, and where it ends, float64[3] rad."""
    chance = _chance(seed, cell, "glance")
    # Saccades keep apart by a fifth of a stretch or more: longer than the longest takes.
    at = (cell + chance.uniform(0, 0.8)) * GLANCE_SECONDS
    if chance.uniform() < AWAY:
        size = min(-GLANCE_SCALE * np.log(chance.uniform(1.0, 15.0) / GLANCE_ODDS), MAX_GLANCE_DEG)
        angle = np.pi / 4 * np.searchsorted(DIRECTIONS, chance.uniform() * DIRECTIONS[-1])
        right, up = size * np.cos(angle), size * np.sin(angle)
    else:
        right, up = np.clip(chance.normal(0, SHIFT_DEG, 2), -3 * SHIFT_DEG, 3 * SHIFT_DEG)
    return at, np.radians([-up, -right, 0.0])


def _chance(seed: int, cell: int, what: str) -> np.random.Generator:
    return np.random.default_rng([abs(seed), int(seed < 0), abs(cell), int(cell < 0), *what.encode()])
