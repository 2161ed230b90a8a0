"""`manifest.json`: what a bundle is and holds. Strict in both directions: what is unknown is refused."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cap4d.bundle.schema import (
    AXES,
    COUNTS,
    FORMAT,
    INT8,
    MANIFEST,
    MAX_ENTRY_BYTES,
    MAX_GRID_VALUES,
    MIN_GRID_SIZE,
    ONNX,
    OPTIONAL_ENTRIES,
    PRECISIONS,
    REQUIRED_ENTRIES,
    RIG_AXES,
    TIERS,
    UNITS,
    VERSION,
)
from cap4d.camera import Camera, is_rigid
from cap4d.errors import DataError
from cap4d.gaussians import SH_COUNTS
from cap4d.rig.head import JOINT_DRIVERS

MAX_NAME = 64  # characters of rig, licence and expression names
MAX_PIXELS = 16384  # of a camera's side
MAX_ERROR_MM = 1e4
POINTS = ("grid", "mesh")
"""Whether the rig's tensors stand on the grid's vertices, or on the rig's, for the reader to mix."""


@dataclass(frozen=True, eq=False)
class Manifest:
    """The manifest's content.

    `entries` maps names to (size in bytes, sha256 in hex), `tier_errors` a deformer's tiers to how far off
    they are: (RMS, largest), mm.
    """

    version: int
    precision: str
    rig_name: str
    rig_licence: str
    rig_points: str
    joint_drivers: tuple[str, ...]
    expression_names: tuple[str, ...]
    expression_range: np.ndarray
    counts: dict[str, int]
    camera: Camera
    idle_fps: float
    entries: dict[str, tuple[int, str]]
    tier_errors: dict[str, tuple[float, float]]

    def to_json(self) -> bytes:
        """The same manifest gives the same bytes."""
        ranges = np.asarray(self.expression_range, np.float32).tolist()
        expressions = [
            {"name": name, "range": limits}
            for name, limits in zip(self.expression_names, ranges, strict=True)
        ]
        camera = self.camera
        document = {
            "format": FORMAT,
            "version": self.version,
            "precision": self.precision,
            "axes": AXES,
            "units": UNITS,
            "rig": {
                "name": self.rig_name,
                "licence": self.rig_licence,
                "axes": RIG_AXES,
                "points": self.rig_points,
                "joints": list(self.joint_drivers),
                "expressions": expressions,
            },
            "counts": {name: self.counts[name] for name in COUNTS},
            "camera": {
                "K": camera.K.tolist(),
                "viewmat": camera.viewmat.tolist(),
                "width": camera.width,
                "height": camera.height,
            },
            "idle": {"fps": self.idle_fps},
            "entries": {
                name: {"size": size, "sha256": digest}
                for name, (size, digest) in sorted(self.entries.items())
            },
        }
        if self.tier_errors:
            document["deformer"] = {
                tier: {"rms_mm": float(f"{rms:.6g}"), "max_mm": float(f"{worst:.6g}")}
                for tier, (rms, worst) in sorted(self.tier_errors.items())
            }
        return (json.dumps(document, indent=1, allow_nan=False, ensure_ascii=True) + "\n").encode()

    @staticmethod
    def from_json(data: bytes, *, source: str) -> Manifest:
        """Reads a manifest.

        Raises:
            DataError: Not JSON, of another format or version, or a field is missing, unknown or out of range.
        """
        where = f"{source}:{MANIFEST}"
        fields = _Fields(where, "", _parse(data, where))
        fields.constant("format", FORMAT)
        version = fields.integer("version", 1, 1 << 30)
        if version > VERSION:
            raise DataError(
                where, "version", expected=f"at most {VERSION} (update cap4d to read it)", found=version
            )
        fields.constant("axes", AXES)
        fields.constant("units", UNITS)
        counts = _counts(fields.group("counts"))
        rig = fields.group("rig")
        rig.constant("axes", RIG_AXES)
        names, ranges = _expressions(rig, counts["expressions"])
        idle = fields.group("idle")
        manifest = Manifest(
            version=version,
            precision=fields.choice("precision", PRECISIONS),
            rig_name=rig.name("name"),
            rig_licence=rig.name("licence"),
            rig_points=rig.choice("points", POINTS),
            joint_drivers=_joints(rig, counts["joints"]),
            expression_names=names,
            expression_range=ranges,
            counts=counts,
            camera=_camera(fields.group("camera")),
            idle_fps=idle.number("fps", 0.1, 1000),
            entries=_entries(fields.group("entries")),
            tier_errors=_tier_errors(fields.group("deformer")) if "deformer" in fields.values else {},
        )
        for group in (idle, rig, fields):
            group.finish()
        _check_points(where, manifest)
        _check_version(where, manifest)
        _check_deformers(where, manifest)
        return manifest


def digest(data: bytes) -> str:
    """SHA-256 in lower-case hex."""
    return hashlib.sha256(data).hexdigest()


def _check_version(where: str, manifest: Manifest) -> None:
    """What a version brought makes a file unreadable to older readers, so such a file must say so."""
    brought = {
        "precision mixed": (2, manifest.precision == "mixed"),
        "deformer": (2, bool(manifest.tier_errors)),
        INT8: (2, INT8 in manifest.entries),
        "grid_size 0": (3, manifest.counts["grid_size"] == 0),
    }
    for name, (version, used) in brought.items():
        if used and manifest.version < version:
            expected = f"{version} or more, for {name}"
            raise DataError(where, "version", expected=expected, found=manifest.version)


def _check_deformers(where: str, manifest: Manifest) -> None:
    """A network sees the pixels of a grid. The rig's own triangles lie on none."""
    if manifest.counts["grid_size"] > 0:
        return
    for name in (ONNX, INT8):
        if name in manifest.entries:
            expected = "no network where grid_size is 0"
            raise DataError(where, f"entries.{name}", expected=expected, found="one")
    if manifest.tier_errors:
        expected, found = "no deformers where grid_size is 0", ", ".join(manifest.tier_errors)
        raise DataError(where, "deformer", expected=expected, found=found)


def _tier_errors(fields: _Fields) -> dict[str, tuple[float, float]]:
    errors = {}
    for tier in TIERS:
        if tier in fields.values:
            error = fields.group(tier)
            errors[tier] = tuple(error.number(name, 0, MAX_ERROR_MM) for name in ("rms_mm", "max_mm"))
            error.finish()
    fields.finish()
    return errors


def _check_points(where: str, manifest: Manifest) -> None:
    kind = {"grid": "grid_vertices", "mesh": "rig_vertices"}[manifest.rig_points]
    points, wanted = manifest.counts["rig_points"], manifest.counts[kind]
    if points != wanted:
        raise DataError(where, "counts.rig_points", expected=f"{wanted}, the number of {kind}", found=points)
    if manifest.counts["grid_size"] == 0:
        _check_own_triangles(where, manifest)
    elif manifest.rig_points == "mesh" and points >= manifest.counts["grid_vertices"]:
        expected = f"fewer than the grid's {manifest.counts['grid_vertices']}, or points on the grid"
        raise DataError(where, "counts.rig_points", expected=expected, found=points)


def _check_own_triangles(where: str, manifest: Manifest) -> None:
    if manifest.rig_points != "mesh":
        raise DataError(where, "rig.points", expected="mesh where grid_size is 0", found=manifest.rig_points)
    points, vertices = manifest.counts["rig_points"], manifest.counts["grid_vertices"]
    if vertices != points:
        expected = f"{points}, the rig's vertices, where grid_size is 0"
        raise DataError(where, "counts.grid_vertices", expected=expected, found=vertices)


def _counts(fields: _Fields) -> dict[str, int]:
    counts = {name: fields.integer(name, *limits) for name, limits in COUNTS.items()}
    fields.finish()
    if counts["sh_coefficients"] not in SH_COUNTS:
        found = counts["sh_coefficients"]
        raise DataError(fields.where, "counts.sh_coefficients", expected="1, 4, 9 or 16", found=found)
    size = counts["grid_size"]
    if 0 < size < MIN_GRID_SIZE:
        expected = f"at least {MIN_GRID_SIZE}, or 0 for the rig's own triangles"
        raise DataError(fields.where, "counts.grid_size", expected=expected, found=size)
    if size > 0 and counts["grid_vertices"] > size**2:
        expected = f"at most {size**2}, the pixels of the grid"
        raise DataError(
            fields.where, "counts.grid_vertices", expected=expected, found=counts["grid_vertices"]
        )
    _check_grid_values(fields.where, counts)
    return counts


def _check_grid_values(where: str, counts: dict[str, int]) -> None:
    """A reader mixes the rig's tensors from few points onto many: the result is bounded, as the file is."""
    for name, per_vertex in (("expressions", 3), ("joints", 27)):
        values = per_vertex * counts[name] * counts["grid_vertices"]
        if values > MAX_GRID_VALUES:
            expected = f"{per_vertex} x {name} x grid_vertices of at most {MAX_GRID_VALUES}"
            raise DataError(where, f"counts.{name}", expected=expected, found=values)


def _expressions(rig: _Fields, count: int) -> tuple[tuple[str, ...], np.ndarray]:
    items = [
        _Fields(rig.where, f"rig.expressions[{i}]", v) for i, v in enumerate(rig.items("expressions", count))
    ]
    names = tuple(item.name("name") for item in items)
    ranges = np.array([item.numbers("range", (2,)) for item in items], np.float32)
    for item in items:
        item.finish()
    if len(set(names)) != count:
        raise DataError(rig.where, "rig.expressions", expected="distinct names", found="the same name twice")
    if not (np.isfinite(ranges).all() and (ranges[:, 0] <= ranges[:, 1]).all()):
        raise DataError(rig.where, "rig.expressions", expected="ranges of finite [min, max]", found="another")
    return names, ranges


def _joints(rig: _Fields, count: int) -> tuple[str, ...]:
    drivers = rig.items("joints", count)
    for driver in drivers:
        if driver not in JOINT_DRIVERS:
            expected = f"one of {', '.join(JOINT_DRIVERS)}"
            raise DataError(rig.where, "rig.joints", expected=expected, found=repr(driver)[:64])
    return tuple(drivers)


def _camera(fields: _Fields) -> Camera:
    K, viewmat = np.array(fields.numbers("K", (3, 3))), np.array(fields.numbers("viewmat", (4, 4)))
    size = [fields.integer(side, 1, MAX_PIXELS) for side in ("width", "height")]
    fields.finish()
    lower = [K[0, 1], K[1, 0], *K[2]] == [0, 0, 0, 0, 1]
    if not (lower and min(K[0, 0], K[1, 1]) > 0 and np.abs(K).max() < 1e7):
        raise DataError(
            fields.where, "camera.K", expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", found=K.tolist()
        )
    if not is_rigid(viewmat):
        raise DataError(fields.where, "camera.viewmat", expected="a rigid motion", found=viewmat.tolist())
    return Camera(K, viewmat, *size)


def _entries(fields: _Fields) -> dict[str, tuple[int, str]]:
    entries = {}
    for name in (*REQUIRED_ENTRIES, *OPTIONAL_ENTRIES):
        if name in OPTIONAL_ENTRIES and name not in fields.values:
            continue
        entry = fields.group(name)
        size, sha256 = entry.integer("size", 1, MAX_ENTRY_BYTES[name]), entry.text("sha256")
        if len(sha256) != 64 or set(sha256) - set("0123456789abcdef"):
            raise DataError(
                fields.where, f"entries.{name}.sha256", expected="64 hex digits", found=repr(sha256[:80])
            )
        entry.finish()
        entries[name] = (size, sha256)
    fields.finish()
    return entries


def _parse(data: bytes, where: str) -> Any:
    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) != len(pairs):
            raise ValueError("a key twice")
        return dict(pairs)

    def refuse(constant: str) -> None:
        raise ValueError(constant)

    try:
        return json.loads(data.decode("utf-8"), object_pairs_hook=once, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise DataError(where, "JSON", expected="a JSON object", found=str(error)[:100]) from None


class _Fields:
    """A JSON object read field by field; `finish` refuses what nobody asked for."""

    def __init__(self, where: str, prefix: str, values: Any) -> None:
        self.where, self.prefix = where, prefix
        if not isinstance(values, dict):
            raise DataError(where, prefix or "JSON", expected="an object", found=type(values).__name__)
        self.values: Mapping[str, Any] = values
        self.seen: set[str] = set()

    def path(self, name: str) -> str:
        return f"{self.prefix}.{name}" if self.prefix else name

    def get(self, name: str, kind: type | tuple[type, ...], expected: str) -> Any:
        self.seen.add(name)
        if name not in self.values:
            raise DataError(self.where, self.path(name), expected=expected, found="nothing")
        value = self.values[name]
        if not isinstance(value, kind) or isinstance(value, bool):
            raise self.wrong(name, expected, value)
        return value

    def wrong(self, name: str, expected: str, found: Any) -> DataError:
        return DataError(self.where, self.path(name), expected=expected, found=repr(found)[:64])

    def finish(self) -> None:
        unknown = sorted(set(self.values) - self.seen)
        if unknown:
            raise DataError(self.where, self.path(unknown[0][:64]), expected="no such field", found="one")

    def constant(self, name: str, value: str) -> None:
        found = self.get(name, str, repr(value))
        if found != value:
            raise self.wrong(name, repr(value), found)

    def choice(self, name: str, choices: tuple[str, ...]) -> str:
        expected = f"one of {', '.join(choices)}"
        found = self.get(name, str, expected)
        if found not in choices:
            raise self.wrong(name, expected, found)
        return found

    def text(self, name: str) -> str:
        return self.get(name, str, "a string")

    def name(self, name: str) -> str:
        """A short printable string."""
        value = self.text(name)
        if not (0 < len(value) <= MAX_NAME and value.isprintable()):
            raise self.wrong(name, f"1 to {MAX_NAME} printable characters", value)
        return value

    def integer(self, name: str, low: int, high: int) -> int:
        expected = f"a whole number in [{low}, {high}]"
        value = self.get(name, int, expected)
        if not low <= value <= high:
            raise self.wrong(name, expected, value)
        return value

    def number(self, name: str, low: float, high: float) -> float:
        expected = f"a number in [{low}, {high}]"
        value = self.get(name, (int, float), expected)
        if not low <= value <= high:
            raise self.wrong(name, expected, value)
        return float(value)

    def items(self, name: str, count: int) -> list:
        value = self.get(name, list, f"a list of {count}")
        if len(value) != count:
            raise DataError(
                self.where, self.path(name), expected=f"{count} of them (counts)", found=len(value)
            )
        return value

    def numbers(self, name: str, shape: tuple[int, ...]) -> list:
        """Nested lists of finite numbers."""
        value = self.get(name, list, f"numbers{list(shape)}")
        if not _is_numeric(value, shape):
            raise self.wrong(name, f"finite numbers{list(shape)}", value)
        return value

    def group(self, name: str) -> _Fields:
        return _Fields(self.where, self.path(name), self.get(name, dict, "an object"))


def _is_numeric(value: Any, shape: tuple[int, ...]) -> bool:
    if not shape:
        plain = isinstance(value, (int, float)) and not isinstance(value, bool)
        return plain and abs(value) < 1e30 and math.isfinite(value)
    return (
        isinstance(value, list) and len(value) == shape[0] and all(_is_numeric(v, shape[1:]) for v in value)
    )
