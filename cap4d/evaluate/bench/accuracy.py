"""How far a picture is from the float64 one, and positions from others."""

from __future__ import annotations

import numpy as np

from cap4d.evaluate.image import psnr_of_mse


def picture_error(picture: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Largest and RMS difference of [H, W, 3] pictures in [0, 1], in steps of 1/255, and PSNR in dB.

    A PSNR of equal pictures is infinite, which JSON has no word for: it becomes 999.
    """
    difference = np.abs(np.asarray(picture, np.float64) - np.asarray(truth, np.float64))
    squared = float(np.square(difference).mean())
    return {
        "max_255": round(float(difference.max()) * 255, 5),
        "rms_255": round(float(np.sqrt(squared)) * 255, 6),
        "psnr_db": round(min(psnr_of_mse(squared), 999.0), 2),
    }


def vertex_error_mm(vertices: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Root mean square and largest distance, mm, between [..., 3] positions in metres."""
    squared = np.square(np.asarray(vertices, np.float64) - truth).sum(-1)
    return {
        "rms_mm": round(float(np.sqrt(squared.mean())) * 1e3, 5),
        "max_mm": round(float(np.sqrt(squared.max())) * 1e3, 5),
    }


def relative_error(value: np.ndarray, truth: np.ndarray) -> float:
    """Norm of the difference over the norm of the truth."""
    norm = float(np.linalg.norm(np.asarray(truth, np.float64)))
    return float(np.linalg.norm(np.asarray(value, np.float64) - truth)) / norm if norm else 0.0
