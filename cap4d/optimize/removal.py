"""What the pictures would lose with each single Gaussian.

A pixel is linear in each opacity (below the clamp at 0.99), so without Gaussian i it changes by exactly o_i
dI/do_i, whatever lies behind. The sum of its square over all pixels and channels is, up to noise, what a
vector-Jacobian product with random signs gives: E[(v . J)^2] = |J|^2 for independent v = +-1 (Hutchinson
1990). Weights of blending, which are often used in its place, do not know what would appear instead.
"""

from __future__ import annotations

import numpy as np

from cap4d import _core
from cap4d.bundle.bundle import Bundle
from cap4d.gaussians import SH_COUNTS
from cap4d.optimize.scene import Scene, tensors
from cap4d.raster.threads import one_torch_thread

HIGHEST = np.float32(0.98)  # opacities are kept below the clamp, above which the gradient is 0
BACKGROUNDS = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
Y00 = 0.28209479177387814


@one_torch_thread()
def removal_errors(bundle: Bundle, scene: Scene, *, seed: int) -> np.ndarray:
    """float64[N]: the mean squared error of the scene's pictures that each Gaussian's removal alone would
    make.

    Half of it on black, half on white; exactly 0 for what no shot shows. Errors of several Gaussians add up
    only while they do not stand in for each other.

    Args:
        seed: Of the signs.
    """
    rng = np.random.default_rng(seed)
    total, values = np.zeros(len(bundle)), 0
    for index in range(len(scene)):
        gaussians, camera = _posed(bundle, scene, index)
        for background in BACKGROUNDS:
            drawn = _drawn(gaussians, camera, background)
            signs = rng.choice(np.float32([-1, 1]), size=drawn[0].shape)
            v_opacities = _vjp(gaussians, drawn, signs)[3]
            total += np.square(v_opacities.astype(np.float64) * gaussians[3])
            values += signs.size
    return total / values


def blending_weights(bundle: Bundle, scene: Scene) -> np.ndarray:
    """float32[K, N]: the sum of each Gaussian's shares in the pixels of each shot.

    A share is the gradient of a pixel by a colour, so the sum is that of the DC coefficient over Y00. The
    largest of the three channels counts: a colour that is clamped at 0 has no gradient.
    """
    weights = []
    for index in range(len(scene)):
        gaussians, camera = _posed(bundle, scene, index)
        drawn = _drawn(gaussians, camera, None)
        v_sh = _vjp(gaussians, drawn, np.ones_like(drawn[0]))[4]
        weights.append(v_sh[:, 0].max(1) / np.float32(Y00))
    return np.stack(weights)


def _posed(bundle: Bundle, scene: Scene, index: int):
    local, binding = tensors(bundle)
    gaussians = [np.ascontiguousarray(x.numpy()) for x in scene.pose(index, local, binding)]
    gaussians[3] = np.minimum(gaussians[3], HIGHEST)
    return gaussians, scene.shots[index].camera


def _drawn(gaussians, camera, background):
    """rgb, alpha, depth and what the backward pass needs."""
    settings = (camera.viewmat, camera.K, camera.width, camera.height, background)
    rgb, alpha, depth, _, _, rendered = _core.rasterize(*gaussians, *settings, _degree(gaussians), 0)
    return rgb, alpha, depth, rendered


def _vjp(gaussians, drawn, v_rgb):
    """Gradients to means, quats, scales, opacities and sh."""
    rgb, alpha, depth, rendered = drawn
    return _core.rasterize_vjp(
        rendered, *gaussians, _degree(gaussians), rgb, alpha, depth, v_rgb, None, None, 0
    )


def _degree(gaussians) -> int:
    return SH_COUNTS[gaussians[4].shape[1]]
