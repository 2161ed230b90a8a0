"""What came out of an evaluation: numbers per view, their means, and what could not be measured."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cap4d.atomic import replacing
from cap4d.evaluate.image import pooled_psnr
from cap4d.evaluate.metrics.metric import Metric, NotMeasured

SCHEMA = 1


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Numbers of an avatar on K views of a capture.

    Args:
        views: (camera, frame) of each.
        metrics: What was measured, by name, in order.
        numbers: By name, float64[K]; NaN where the face (or open eye) was not found in both images.
        missing: What could not be measured, by name.
        faces: float64[K, 2] 1 where a face was found in the picture and in the truth; None: not looked for.
        facts: What else the report says: files, versions, settings, seconds.
    """

    views: tuple[tuple[str, int], ...]
    metrics: Mapping[str, Metric]
    numbers: Mapping[str, np.ndarray]
    missing: Mapping[str, NotMeasured]
    faces: np.ndarray | None
    facts: Mapping[str, Any]

    def values(self, name: str) -> np.ndarray:
        """float64[K] of a metric that was measured; NaN where a view could not be."""
        return self.numbers[name]

    def mean(self, name: str) -> float | None:
        """Over the views that could be measured; None where none could."""
        return None if name not in self.numbers else _mean(self.numbers[name])

    def pooled_psnr(self) -> float | None:
        """PSNR of the squared error pooled over the views (of one size, or each weighing the same), dB."""
        if "PSNR" not in self.numbers:
            return None
        return pooled_psnr(10 ** (-self.numbers["PSNR"] / 10))

    def document(self) -> dict[str, Any]:
        """The report, ready for JSON: no NaN, no infinity."""
        return {
            "schema": SCHEMA,
            **self.facts,
            "views": [list(view) for view in self.views],
            "faces": self._face_counts(),
            "metrics": {name: self._entry(name) for name in (*self.metrics, *self.missing)},
        }

    def write(self, path: Path) -> None:
        """Writes the report as JSON, whole or not at all."""
        with replacing(path) as temporary:
            text = json.dumps(self.document(), indent=1, allow_nan=False, ensure_ascii=False)
            temporary.write_text(text + "\n", encoding="utf-8")

    def table(self) -> str:
        """A line per metric, for people."""
        lines = [f"{'metric':<8} {'mean':>9} {'':<9} {'views':>9}  "]
        lines += [self._line(name) for name in self.metrics]
        needs = dict.fromkeys(absent.needs for absent in self.missing.values())
        for need in needs:
            names = ", ".join(name for name, absent in self.missing.items() if absent.needs == need)
            lines.append(f"{names}: not measured: needs {need}")
        return "\n".join(line.rstrip() for line in lines)

    def _line(self, name: str) -> str:
        metric, mean, measured = self.metrics[name], self.mean(name), self._count(name)
        number = "none" if mean is None else f"{mean:.{metric.decimals}f}"
        arrow = "higher is better" if metric.better == "higher" else "lower is better"
        return f"{name:<8} {number:>9} {metric.unit:<9} {measured:>4}/{len(self.views):<4}  {arrow}"

    def _count(self, name: str) -> int:
        return int(np.isfinite(self.numbers[name]).sum())

    def _entry(self, name: str) -> dict[str, Any]:
        if name in self.missing:
            return {"mean": None, "not_measured": f"needs {self.missing[name].needs}"}
        metric, values = self.metrics[name], self.numbers[name]
        entry: dict[str, Any] = {"mean": _mean(values)}
        if name == "PSNR":
            entry["pooled"] = self.pooled_psnr()
        return entry | {
            "unit": metric.unit,
            "better": metric.better,
            "measured": self._count(name),
            "not_found": len(values) - self._count(name),
            "by_camera": self._by_camera(values),
            "values": [None if np.isnan(value) else float(value) for value in values],
            "definition": _definition(metric),
        }

    def _by_camera(self, values: np.ndarray) -> dict[str, float | None]:
        names = np.array([camera for camera, _ in self.views])
        return {str(name): _mean(values[names == name]) for name in dict.fromkeys(names.tolist())}

    def _face_counts(self) -> dict[str, int] | None:
        if self.faces is None:
            return None
        image, truth = self.faces.T > 0
        counts = {"views": len(image), "in_picture": image.sum(), "in_truth": truth.sum()}
        counts |= {"in_both": (image & truth).sum(), "lost_by_avatar": (truth & ~image).sum()}
        return {name: int(count) for name, count in counts.items()}


def _mean(values: np.ndarray) -> float | None:
    found = values[np.isfinite(values)]
    return float(found.mean()) if len(found) else None


def _definition(metric: Metric) -> str:
    """A metric's docstring, in one line."""
    return " ".join((type(metric).__doc__ or "").split())
