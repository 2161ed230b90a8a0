"""What a bench is asked to do."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from cap4d.evaluate.bench.scenes import Scene, SceneSource, gaussian_count

QUICK_SIDE = 128  # px
SECTIONS = ("ceilings", "splat", "fit", "deformer", "frame", "optimize", "peers")


@dataclass(frozen=True)
class Settings:
    """How long and how much.

    Args:
        sections: Of `SECTIONS`.
        threads: Of everything that has threads.
        quick: A smoke test: small scenes, few runs. Its numbers mean nothing.
        avatars: `.cap4d` files.
        scenes: Folder of scenes, or None for the package's own.
    """

    sections: tuple[str, ...] = SECTIONS
    threads: int = 2
    quick: bool = False
    avatars: tuple[Path, ...] = field(default=())
    scenes: Path | None = None

    @property
    def runs(self) -> int:
        """That a number of the first table is of."""
        return 5 if self.quick else 40

    @property
    def short_runs(self) -> int:
        """Of each point of the scaling curves."""
        return 3 if self.quick else 30

    @property
    def slow_runs(self) -> int:
        """Of peers that take seconds."""
        return 1 if self.quick else 5

    @property
    def frames(self) -> int:
        """Of an avatar."""
        return 6 if self.quick else 200

    @property
    def samples(self) -> int:
        """Of an avatar's frames that are compared with float64."""
        return 2 if self.quick else 6

    @property
    def max_side(self) -> int:
        """px, of the pictures in the scaling curves."""
        return 256 if self.quick else 1024

    @property
    def ceiling_seconds(self) -> float:
        return 0.02 if self.quick else 0.5

    def count(self, name: str) -> int | None:
        """Gaussians of the package's own scenes where they differ from what the name says."""
        return gaussian_count(name) // 100 if self.quick and self.scenes is None else None

    def load(self, source: SceneSource, name: str) -> Scene:
        scene = source.load(name, count=self.count(name))
        return scene.resized(QUICK_SIDE) if self.quick else scene
