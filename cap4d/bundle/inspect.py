"""What is in a `.cap4d` file, for people."""

from __future__ import annotations

from pathlib import Path

from cap4d.bundle.bundle import Bundle
from cap4d.bundle.manifest import Manifest
from cap4d.bundle.reader import read_bundle, read_manifest
from cap4d.gaussians import SH_COUNTS


def describe(path: str | Path) -> str:
    """A few lines about a bundle, which is read and checked in full.

    Raises:
        DataError: The file is not a sound bundle.
    """
    path = Path(path)
    manifest = read_manifest(path)
    return "\n".join(_lines(path, manifest, read_bundle(path)))


def _lines(path: Path, manifest: Manifest, bundle: Bundle) -> list[str]:
    counts, camera = manifest.counts, manifest.camera
    size, degree = counts["grid_size"], SH_COUNTS[counts["sh_coefficients"]]
    surface = f"grid: {size}x{size}" if size else "grid: none, the rig's own triangles"
    seconds = counts["idle_frames"] / manifest.idle_fps
    lines = [
        f"{path}: {path.stat().st_size / 1e6:.1f} MB, version {manifest.version}, {manifest.precision}, "
        "every hash and value checked",
        f"rig: {manifest.rig_name} ({manifest.rig_licence}), {counts['expressions']} expressions, "
        f"{counts['joints']} joints ({', '.join(manifest.joint_drivers) or 'none'})",
        f"{surface}, {counts['grid_vertices']} vertices, {counts['faces']} faces",
        f"gaussians: {counts['gaussians']}, spherical harmonics of degree {degree}",
        f"camera: {camera.width}x{camera.height}, focal length {camera.K[0, 0]:.1f} px",
        f"idle clip: {counts['idle_frames']} frames, {seconds:.1f} s at {manifest.idle_fps:g} fps",
        f"deformers: {', '.join(_deformers(bundle, manifest))}",
        "entries:",
    ]
    lines += [
        f"  {name:<32} {size:>11,} bytes  sha256 {sha[:12]}" for name, (size, sha) in manifest.entries.items()
    ]
    lines += ["expressions:"]
    for name, (low, high) in zip(manifest.expression_names, manifest.expression_range, strict=True):
        lines.append(f"  {name:<32} {low:+.2f} to {high:+.2f}")
    return lines


def _deformers(bundle: Bundle, manifest: Manifest) -> list[str]:
    """The tiers that the file can play, each with its error where the file says it."""
    lines = []
    for tier in bundle.tiers:
        rms, worst = manifest.tier_errors.get(tier, (0.0, 0.0))
        known = tier in manifest.tier_errors
        lines.append(f"{tier} ({rms:.3f} mm RMS, {worst:.2f} mm at most)" if known else tier)
    return lines
