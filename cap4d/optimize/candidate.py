"""An avatar on its way to a smaller file: its numbers, how they will lie there, and its deformer."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.container import put_entries
from cap4d.bundle.packing import Form, rounded
from cap4d.bundle.schema import GAUSSIANS, GRID, ONNX, RIG, TENSORS
from cap4d.bundle.writer import PACKED, bundle_entries, stored_subject, write_bundle
from cap4d.player.avatar import Avatar
from cap4d.rig.head import Subject

DEFORMER_PARTS = {
    "full": "deform_onnx",
    "fp16": "deform_onnx",
    "int8": "deform_int8",
    "linear": "deform_linear",
}


@dataclass(frozen=True, eq=False)
class Candidate:
    """A bundle with every deformer that is at hand, and what of it goes into the file.

    Args:
        bundle: Numbers in float32, before they are rounded to their forms.
        tier: The deformer that plays; the others stay out of the file.
        forms: The form of each packed tensor; float32 where there is none.
    """

    bundle: Bundle
    tier: str
    forms: Mapping[str, Form]

    def stored(self) -> Bundle:
        """What comes back from the file, but for the network's weights, which a player rounds as it loads."""
        bundle = self._with_one_deformer()
        gaussians = {
            name: self._rounded(GAUSSIANS, name, getattr(bundle, name))
            for name in PACKED
            if name in TENSORS[GAUSSIANS]
        }
        linear = bundle.deform_linear
        if linear is not None:
            linear = self._rounded(GRID, "deform_linear", linear)
        bundle = replace(bundle, **gaussians, deform_linear=linear)
        return with_subject(bundle, self._rounded_subject)

    def avatar(self, *, threads: int = 0) -> Avatar:
        """The player of it."""
        return Avatar(self.stored(), deformer=self.tier, threads=threads)

    def entries(self) -> dict[str, bytes]:
        """What `write` writes."""
        return bundle_entries(self._with_one_deformer(), precision=self._precision())

    def size(self) -> int:
        """Bytes of the file."""
        stream = io.BytesIO()
        put_entries(stream, self.entries())
        return stream.tell()

    def write(self, path: Path) -> None:
        """Writes the file; see `write_bundle`."""
        write_bundle(self._with_one_deformer(), path, precision=self._precision())

    def _precision(self) -> dict[str, Form]:
        return dict(self.forms) | ({ONNX: "float16"} if self.tier == "fp16" else {})

    def _with_one_deformer(self) -> Bundle:
        kept = DEFORMER_PARTS.get(self.tier)
        gone = {part: None for part in DEFORMER_PARTS.values() if part != kept}
        errors = {tier: error for tier, error in self.bundle.tier_errors.items() if tier == self.tier}
        return replace(self.bundle, **gone, tier_errors=errors)

    def _rounded_subject(self, subject: Subject) -> Subject:
        names = (name for name in PACKED if name in TENSORS[RIG] and getattr(subject, name) is not None)
        return replace(subject, **{name: self._rounded(RIG, name, getattr(subject, name)) for name in names})

    def _rounded(self, entry: str, name: str, values: np.ndarray) -> np.ndarray:
        return rounded(values, TENSORS[entry][name], self.forms.get(name, "float32"))


def with_subject(bundle: Bundle, change: Callable[[Subject], Subject]) -> Bundle:
    """The bundle with its head changed on the points that a file holds: the mesh's where those are fewer."""
    if stored_subject(bundle) is bundle.subject:
        return replace(bundle, subject=change(bundle.subject), mesh_subject=None)
    mesh = change(bundle.mesh_subject)
    return replace(bundle, mesh_subject=mesh, subject=mesh.resample(bundle.grid.vertices, bundle.grid.bary))


def with_gaussians(bundle: Bundle, kept: np.ndarray) -> Bundle:
    """The bundle with some of its Gaussians.

    Args:
        kept: int64[K] or bool[N].
    """
    names = ("means", "quats", "log_scales", "opacity_logits", "sh", "binding")
    return replace(bundle, **{name: np.ascontiguousarray(getattr(bundle, name)[kept]) for name in names})
