"""Recordings of Live Link Face: a row a frame, `Timecode`, `BlendShapeCount`, 52 weights and 9 angles by
name.

The order of columns differs between versions of the app, so their names are read. A time code is
HH:MM:SS:FF.part, in frames of a rate that the file does not name: the least usual one that its largest FF
fits.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.drive.arkit import NAMES, arkit_map
from cap4d.drive.clip import Clip
from cap4d.drive.fit import MAX_FRAMES
from cap4d.drive.livelink import ANGLES, pose_of_angles
from cap4d.errors import DataError

MAX_BYTES = 512 << 20
MAX_LINE = 1 << 14  # characters
RATES = (24, 25, 30, 50, 60, 120)  # of time codes
SNAP = 0.02  # relative distance from a usual rate that is taken for it
DAY = 86400.0
MAX_GAP = 60.0  # s between rows


def read_livelink_csv(path: Path, bundle: Bundle, *, fps: float | None = None) -> Clip:
    """A recording as a clip of the avatar's expressions, at a constant rate.

    Rows without a face are passed over: the face goes straight on to the next that has one.

    Args:
        fps: A row every 1 / fps s, whatever the time codes say.
    Raises:
        ArgumentError: The avatar's rig cannot show ARKit's expressions.
        DataError: Not such a recording.
    """
    convert = arkit_map(bundle)
    rate, even = read_values(path, fps=fps)
    expr, eye_rot, jaw_rot = convert(even[:, : len(NAMES)])
    zeros = np.zeros((len(even), 3), np.float32)
    pose = {"eye_rot": eye_rot, "neck_rot": zeros} | pose_of_angles(even[:, len(NAMES) :])
    return Clip(bundle.rig_name, rate, expr.astype(np.float32), jaw_rot=jaw_rot.astype(np.float32), **pose)


def read_values(path: Path, *, fps: float | None = None) -> tuple[float, np.ndarray]:
    """A recording in its own terms: (rate, float32[T, 61]), the order of `NAMES` and `ANGLES`; see above.

    Raises:
        DataError: Not such a recording.
    """
    times, values = _read(path, fps)
    rate = fps or _rate(times)
    count = round((times[-1] - times[0]) * rate) + 1
    if count > MAX_FRAMES:
        raise DataError(path, "Timecode", expected=f"at most {MAX_FRAMES} frames", found=count)
    wanted = times[0] + np.arange(count) / rate
    return rate, np.stack([np.interp(wanted, times, column) for column in values.T], 1).astype(np.float32)


def _read(path: Path, fps: float | None) -> tuple[np.ndarray, np.ndarray]:
    """float64[N] s and float64[N, 61] of the rows with a face."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DataError(path, "size", expected=f"at most {MAX_BYTES} bytes", found=path.stat().st_size)
        with path.open(encoding="utf-8-sig", errors="replace", newline="") as stream:
            rows = csv.reader(_lines(path, stream))
            columns = _columns(path, next(rows, []))
            return _numbers(path, rows, columns, fps)
    except FileNotFoundError as error:
        raise DataError(
            path, "file", expected="a recording of Live Link Face", found="no such file"
        ) from error
    except (OSError, csv.Error) as error:
        raise DataError(path, "file", expected="a recording of Live Link Face", found=error) from error


def _lines(path: Path, stream):
    while line := stream.readline(MAX_LINE):
        if len(line) >= MAX_LINE:
            raise DataError(path, "line", expected=f"at most {MAX_LINE} characters", found="more")
        yield line


def _columns(path: Path, header: list[str]) -> list[int]:
    """Of the time code and of each value, where they stand; -1 for an angle that is not there."""
    place = {name.strip().lower(): column for column, name in enumerate(header)}
    for name in ("Timecode", *NAMES):
        if name.lower() not in place:
            found = ",".join(header)[:60] or "nothing"
            raise DataError(
                path, "header", expected=f"a column {name}, as Live Link Face writes it", found=found
            )
    return [place["timecode"], *(place.get(name.lower(), -1) for name in (*NAMES, *ANGLES))]


def _numbers(path: Path, rows, columns: list[int], fps: float | None) -> tuple[np.ndarray, np.ndarray]:
    codes, values, places = [], [], []
    for number, row in enumerate(rows):
        if number >= MAX_FRAMES:
            raise DataError(path, "rows", expected=f"at most {MAX_FRAMES}", found="more")
        if len(row) <= max(columns):  # no face
            continue
        try:
            values.append([0.0 if column < 0 else float(row[column]) for column in columns[1:]])
            codes.append(_time_code(row[columns[0]]))
        except ValueError as error:
            raise DataError(
                path, f"row {number + 2}", expected="a time code and numbers", found=error
            ) from error
        places.append(number)
    if not values:
        raise DataError(path, "rows", expected="at least one with a face", found="none")
    found = np.array(values)
    if not (np.abs(found) < 1e6).all():  # nor is what is not a number
        raise DataError(path, "values", expected="finite weights and angles", found="one that is not")
    return np.array(places) / fps if fps else _seconds(path, np.array(codes)), found


def _time_code(text: str) -> tuple[float, float]:
    """(seconds of the day, frames within the second)"""
    hours, minutes, seconds, frames = text.strip().split(":")
    code = 3600 * int(hours) + 60 * int(minutes) + int(seconds), float(frames)
    if not (0 <= code[0] < DAY and 0 <= code[1] < RATES[-1]):
        raise ValueError(f"{text[:32]!r}")
    return code


def _seconds(path: Path, codes: np.ndarray) -> np.ndarray:
    """[N] s from (second, frame) codes, midnights passed."""
    base = next(rate for rate in RATES if codes[:, 1].max() < rate)
    times = codes[:, 0] + codes[:, 1] / base
    steps = np.diff(times)
    steps[steps < -DAY / 2] += DAY
    if (steps <= 0).any() or (steps > MAX_GAP).any():
        row = int(np.flatnonzero((steps <= 0) | (steps > MAX_GAP))[0])
        expected = f"time codes that rise, by {MAX_GAP:g} s at most"
        raise DataError(path, "Timecode", expected=expected, found=f"a step of {steps[row]:.3f} s")
    return np.concatenate([[0.0], np.cumsum(steps)])


def _rate(times: np.ndarray) -> float:
    """Frames a second: the median, or the usual rate that it means."""
    if len(times) < 2:
        return 60.0
    found = 1 / float(np.median(np.diff(times)))
    near = min(RATES, key=lambda rate: abs(rate - found))
    return float(near) if abs(near - found) < SNAP * near else found
