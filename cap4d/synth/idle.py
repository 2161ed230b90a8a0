"""Idle motion for any rig: blinks, glances, a few spoken-looking mouth shapes, small smiles, a gentle neck.

Rigs with ARKit's names (`eyeBlinkLeft`, or ICT's `eyeBlink_L`) are driven by name; others by gentle smooth
coefficients within their range. Everything is periodic, so that a clip loops without a jump.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from cap4d.drive.clip import Clip
from cap4d.rig.head import HeadRig, Subject

BLINK_CLOSE, BLINK_SHUT, BLINK_OPEN = 0.075, 0.04, 0.16  # s
BLINK_EVERY = (2.2, 4.2)  # s between blinks
FIXATION = (0.5, 1.6)  # s between glances
GLANCE = np.radians([3.5, 8.0])  # standard deviation down and sideways
SACCADE = 0.045  # s
SYLLABLE = (0.13, 0.24)  # s
FULL_LOOK = np.radians(25.0)  # a gaze that far moves the lids by 1

VISEMES: tuple[dict[str, float], ...] = (
    {"jawOpen": 0.26, "mouthLowerDown": 0.18, "mouthStretch": 0.05},
    {"jawOpen": 0.10, "mouthSmile": 0.16, "mouthStretch": 0.14, "mouthUpperUp": 0.12, "mouthLowerDown": 0.16},
    {"jawOpen": 0.12, "mouthFunnel": 0.34, "mouthPucker": 0.12},
    {"jawOpen": 0.06, "mouthPucker": 0.42},
    {"mouthPress": 0.26, "mouthRollLower": 0.16, "mouthRollUpper": 0.10},
    {"jawOpen": 0.06, "mouthRollLower": 0.22, "mouthUpperUp": 0.16},
    {"jawOpen": 0.14, "mouthLowerDown": 0.16, "mouthUpperUp": 0.10},
)
SMILE = {"mouthSmile": 0.42, "cheekSquint": 0.30, "eyeSquint": 0.10, "mouthDimple": 0.10}
EMPHASIS = {"browInnerUp": 0.30, "browOuterUp": 0.22}


def idle_clip(rig: HeadRig | Subject, *, fps: float = 30.0, seconds: float = 8.0, seed: int = 0) -> Clip:
    """Natural idle motion for `rig`, the same for the same seed; it can be repeated seamlessly.

    Returns:
        `round(fps * seconds)` frames, at least one.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(max(1, round(fps * seconds))) / fps
    gaze = _gaze(rng, times, seconds)
    expr = (
        _by_name(rig, rng, times, seconds, gaze)
        if speaks_arkit(rig)
        else _by_number(rig, rng, times, seconds)
    )
    neck = np.radians([1.6, 2.4, 1.0]) * _drift(rng, times, seconds, 3)
    zeros = np.zeros((len(times), 3), np.float32)
    name = rig.name if isinstance(rig, HeadRig) else rig.rig_name
    poses = {"eye_rot": gaze.astype(np.float32), "neck_rot": neck.astype(np.float32), "jaw_rot": zeros}
    return Clip(name, fps, expr.astype(np.float32), **poses)


def speaks_arkit(rig: HeadRig | Subject) -> bool:
    """Whether the rig's expressions carry ARKit's names."""
    return {"eyeblinkleft", "jawopen"} <= {_plain(n) for n in rig.expression_names}


def expression_vector(rig: HeadRig | Subject, weights: Mapping[str, float]) -> np.ndarray:
    """float32[E] with ARKit weights set by name, in either spelling; a name without a side sets both sides.

    Names that the rig lacks are left out.
    """
    expr = np.zeros(len(rig.expression_names), np.float32)
    for i, own in enumerate(rig.expression_names):
        plain = _plain(own)
        for name, weight in weights.items():
            wanted = _plain(name)
            if plain in (wanted, wanted + "left", wanted + "right") or plain + "left" == wanted:
                expr[i] += weight
    return expr


def look_weights(gaze: np.ndarray) -> dict[str, float]:
    """How the lids follow a gaze [3] (axis-angle, rad; positive x looks down, positive y to the person's
    left).
    """
    down, left = np.asarray(gaze[:2]) / FULL_LOOK
    return {
        "eyeLookDown": max(down, 0.0),
        "eyeLookUp": max(-down, 0.0),
        "eyeLookOutLeft": max(left, 0.0),
        "eyeLookInRight": max(left, 0.0),
        "eyeLookInLeft": max(-left, 0.0),
        "eyeLookOutRight": max(-left, 0.0),
    }


def _plain(name: str) -> str:
    """`eyeBlink_L` and `eyeBlinkLeft` -> `eyeblinkleft`."""
    name = re.sub(r"_L$", "Left", re.sub(r"_R$", "Right", name))
    return name.replace("_", "").lower()


def _by_name(
    rig, rng: np.random.Generator, times: np.ndarray, seconds: float, gaze: np.ndarray
) -> np.ndarray:
    expr = np.zeros((len(times), len(rig.expression_names)))
    talk_end = 0.55 * seconds
    for weights, start, width in _syllables(rng, 0.08 * seconds, talk_end):
        expr += np.outer(_bell(times, start, width, seconds), expression_vector(rig, weights))
    smile = _plateau(times, 0.64 * seconds, 0.88 * seconds, 0.35)
    expr += np.outer(smile, expression_vector(rig, SMILE))
    for start in rng.uniform(0.1 * seconds, talk_end, max(1, round(seconds / 4))):
        expr += np.outer(_bell(times, start, 0.28, seconds), expression_vector(rig, EMPHASIS))
    blink = blinks(rng, times, seconds)
    expr += np.outer(blink, expression_vector(rig, {"eyeBlink": 1.0}))
    for t, turn in enumerate(gaze):
        expr[t] += (1 - blink[t]) * expression_vector(rig, look_weights(turn))
    low, high = np.asarray(rig.expression_range).T if isinstance(rig, HeadRig) else (0.0, 1.0)
    return np.clip(expr, low, high)


def _by_number(rig, rng: np.random.Generator, times: np.ndarray, seconds: float) -> np.ndarray:
    """Smooth coefficients within a quarter of their range; the last one blinks where it is CAP4D's blink
    (fact 4).
    """
    n = len(rig.expression_names)
    span = np.asarray(rig.expression_range) if isinstance(rig, HeadRig) else np.tile([-1.0, 1.0], (n, 1))
    falloff = 1 / (1 + np.arange(n) / 8)
    expr = np.clip(0.25 * _drift(rng, times, seconds, n), -0.5, 0.5) * falloff * (span[:, 1] - span[:, 0]) / 2
    blinking = [i for i, name in enumerate(rig.expression_names) if "blink" in name.lower()]
    expr[:, blinking] = 0.93 * blinks(rng, times, seconds)[:, None]
    return np.clip(expr, span[:, 0], span[:, 1])


def _drift(rng: np.random.Generator, times: np.ndarray, seconds: float, channels: int) -> np.ndarray:
    """[T, channels] slow noise of about unit size made of a few harmonics of the clip's length, zero at its
    start.
    """
    harmonics = np.arange(1, 1 + max(2, round(seconds * 0.45)))
    phases = 2 * np.pi * (times[:, None] / seconds) * harmonics
    waves = np.concatenate([np.sin(phases), np.cos(phases) - 1], 1)
    size = rng.normal(0, 1, (waves.shape[1], channels)) / np.sqrt(np.tile(harmonics, 2))[:, None]
    return waves @ size * 0.5


def _bell(times: np.ndarray, centre: float, width: float, seconds: float) -> np.ndarray:
    away = (times - centre + seconds / 2) % seconds - seconds / 2
    return np.exp(-0.5 * (away / (0.42 * width)) ** 2)


def _plateau(times: np.ndarray, start: float, end: float, ease: float) -> np.ndarray:
    rise, fall = np.clip((times - start) / ease, 0, 1), np.clip((end - times) / ease, 0, 1)
    share = np.minimum(rise, fall)
    return share * share * (3 - 2 * share)


def _syllables(rng: np.random.Generator, start: float, end: float):
    """Yields (weights, time, width) of spoken-looking mouth shapes, with short pauses between words."""
    at = start
    while at < end:
        width = rng.uniform(*SYLLABLE)
        loudness = rng.uniform(0.6, 1.1)
        shape = VISEMES[rng.integers(len(VISEMES))]
        yield {name: loudness * weight for name, weight in shape.items()}, at, width
        at += width * 0.95 + (rng.random() < 0.14) * rng.uniform(0.15, 0.4)


def blinks(rng: np.random.Generator, times: np.ndarray, seconds: float) -> np.ndarray:
    """[T] how far the lids are closed, in [0, 1]; no blink is cut by the clip's ends."""
    closed = np.zeros(len(times))
    at = rng.uniform(0.5, 1.2)
    whole = BLINK_CLOSE + BLINK_SHUT + BLINK_OPEN
    while at + whole < seconds:
        since = times - at
        down = np.clip(since / BLINK_CLOSE, 0, 1)
        up = np.clip((since - BLINK_CLOSE - BLINK_SHUT) / BLINK_OPEN, 0, 1)
        closed = np.maximum(closed, down * down * (3 - 2 * down) * (1 - up * up * (3 - 2 * up)))
        at += rng.uniform(*BLINK_EVERY) if rng.random() > 0.12 else whole + 0.12
    return closed


def _gaze(rng: np.random.Generator, times: np.ndarray, seconds: float) -> np.ndarray:
    """[T, 3] rad: fixations with quick moves between; straight ahead at the clip's ends."""
    starts, targets = [0.0], [np.zeros(3)]
    at = rng.uniform(*FIXATION)
    while at < seconds - 0.6:
        aside = rng.normal(0, GLANCE) if rng.random() < 0.62 else np.zeros(2)
        starts.append(at)
        targets.append(np.array([*np.clip(aside, -2 * GLANCE, 2 * GLANCE), 0.0]))
        at += rng.uniform(*FIXATION)
    starts.append(max(seconds - 0.4, starts[-1] + SACCADE))
    targets.append(np.zeros(3))
    gaze = np.tile(targets[0], (len(times), 1))
    for start, before, after in zip(starts[1:], targets[:-1], targets[1:], strict=True):
        share = np.clip((times - start) / SACCADE, 0, 1)[:, None]
        gaze += share * share * (3 - 2 * share) * (after - before)
    return gaze
