"""What others need for the same pictures, in the same process and in turns with ours.

gsplat (Ye et al. 2024) has readable PyTorch functions beside its CUDA kernels. On a CPU they project,
evaluate spherical harmonics and composite; which pixels meet which Gaussians only its CUDA code can list, so
that list is given to it
ready made: exactly the pairs that are blended, more than a renderer is ever told. Two functions of nerfacc
    that it
calls exist for CUDA only; `_nerfacc_on_cpu` is what they do.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from cap4d.evaluate.bench.accuracy import picture_error
from cap4d.evaluate.bench.passes import Playing, forward_backward, random_gradient
from cap4d.evaluate.bench.scenes import Scene, SceneSource
from cap4d.evaluate.bench.settings import Settings
from cap4d.evaluate.bench.tiled import (
    EPS2D,
    TRANSMITTANCE_MIN,
    Picture,
    pixel_alphas,
    project,
    render_tiled,
    tiles,
)
from cap4d.evaluate.bench.timing import measure

log = logging.getLogger(__name__)

SCENES = ("head_30k", "head_100k")
REST_S = 0.05  # other packages' threads spin for a while after their work


@dataclass(frozen=True, eq=False)
class Peer:
    """One other way to the same picture.

    Args:
        forward: Draws; returns [H, W, 3] in [0, 1], premultiplied.
        forward_backward: Draws, and gives all gradients; or None.
    """

    forward: Callable[[], np.ndarray]
    forward_backward: Callable[[], object] | None = None


def measure_peers(source: SceneSource, settings: Settings) -> dict[str, Any]:
    """Times of each peer and of ours in turns, ratios, and how far each picture is from the float64 one."""
    scenes, missing = [], []
    for name in SCENES:
        log.info("peers: %s", name)
        scene = settings.load(source, name)
        truth = render_tiled(scene.gaussians, scene.camera)
        peers, missing = find_peers(scene, settings)
        scenes.append(_compare(scene, truth, peers, settings))
    return {"threads": settings.threads, "scenes": scenes, "not_measured": missing}


def find_peers(scene: Scene, settings: Settings) -> tuple[dict[str, Peer], list[str]]:
    """The peers that can run here, and a line for each that cannot."""
    makers = {
        "NumPy, float32, tile by tile": _numpy_peer,
        "gsplat's PyTorch functions, pairs given": gsplat_peer,
    }
    peers, missing = {}, []
    for name, make in makers.items():
        try:
            peers[name] = make(scene, settings)
        except ModuleNotFoundError as error:
            missing.append(f"{name}: needs the package {error.name}")
    return peers, missing


def _compare(scene: Scene, truth: Picture, peers: dict[str, Peer], settings: Settings) -> dict[str, Any]:
    makers = {"forward": Playing, "forward_backward": forward_backward}
    ours = {kind: make(scene, threads=settings.threads) for kind, make in makers.items()}
    calls = {("ours", kind): call for kind, call in ours.items()}
    for name, peer in peers.items():
        calls[name, "forward"] = peer.forward
        if peer.forward_backward is not None:
            calls[name, "forward_backward"] = peer.forward_backward
    timings = measure(
        {"|".join(key): call for key, call in calls.items()}, runs=settings.slow_runs, rest_s=REST_S
    )
    rows = []
    for name in ("ours", *peers):
        row: dict[str, Any] = {"name": name}
        for kind in ours:
            timing = timings.get(f"{name}|{kind}")
            row[kind] = None if timing is None else timing.report()
            row[f"{kind}_ratio"] = (
                None if timing is None else round(timing.median_ms / timings[f"ours|{kind}"].median_ms, 2)
            )
        picture = ours["forward"].rgb() if name == "ours" else peers[name].forward()
        rows.append({**row, "error": picture_error(picture, truth.rgb)})
    return {"name": scene.name, "rows": rows}


def _numpy_peer(scene: Scene, settings: Settings) -> Peer:
    return Peer(lambda: render_tiled(scene.gaussians, scene.camera, dtype=np.float32).rgb)


def gsplat_peer(scene: Scene, settings: Settings) -> Peer:
    """gsplat's readable functions on the CPU.

    Raises:
        ModuleNotFoundError: gsplat or nerfacc is not installed.
    """
    torch = importlib.import_module("torch")
    functions = importlib.import_module("gsplat.cuda._torch_impl")
    importlib.import_module("nerfacc")
    torch.set_num_threads(settings.threads)
    width, height = scene.camera.width, scene.camera.height
    viewmat, K = (torch.tensor(x, dtype=torch.float32)[None] for x in (scene.camera.viewmat, scene.camera.K))
    position = torch.tensor(scene.camera.position, dtype=torch.float32)
    gaussian_ids, pixel_ids = map(torch.from_numpy, blended_pairs(scene))
    image_ids = torch.zeros_like(gaussian_ids)
    v_rgb = torch.from_numpy(random_gradient(scene))

    def draw(means: Any, quats: Any, scales: Any, opacities: Any, sh: Any) -> Any:
        covariances, _ = functions._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        _, means2d, _, conics, _ = functions._fully_fused_projection(
            means, covariances, viewmat, K, width, height, eps2d=EPS2D
        )
        directions = means - position
        degree = scene.gaussians.sh_degree
        colors = (functions._spherical_harmonics(degree, directions, sh) + 0.5).clamp(min=0)
        with _nerfacc_on_cpu():
            image, _ = functions.accumulate(
                means2d,
                conics,
                opacities[None],
                colors[None],
                gaussian_ids,
                pixel_ids,
                image_ids,
                width,
                height,
            )
        return image[0]

    def forward() -> np.ndarray:
        with torch.no_grad():
            return draw(*map(torch.from_numpy, scene.fields)).numpy()

    def forward_backward() -> None:
        fields = [torch.from_numpy(field).requires_grad_() for field in scene.fields]
        draw(*fields).backward(v_rgb)

    return Peer(forward, forward_backward)


def blended_pairs(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Gaussian ids and pixel ids (row-major), int64, of all that is blended: by pixel, near to far."""
    splats = project(scene.gaussians, scene.camera)
    gaussians, pixels = [], []
    for tile in tiles(splats, scene.camera):
        alphas = pixel_alphas(splats, tile.members, tile)
        shown = (alphas > 0) & (np.cumprod(1 - alphas, 0) >= TRANSMITTANCE_MIN)
        local, member = np.nonzero(shown.T)
        y, x = np.divmod(local, tile.width)
        gaussians.append(splats.ids[tile.members[member]])
        pixels.append((tile.y0 + y) * scene.camera.width + tile.x0 + x)
    if not gaussians:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    gaussian_ids, pixel_ids = np.concatenate(gaussians), np.concatenate(pixels)
    order = np.argsort(pixel_ids, kind="stable")
    return gaussian_ids[order], pixel_ids[order]


@contextmanager
def _nerfacc_on_cpu() -> Iterator[None]:
    """The two functions of nerfacc that exist for CUDA tensors only, for CPU tensors."""
    torch, volrend = importlib.import_module("torch"), importlib.import_module("nerfacc.volrend")
    originals = {name: getattr(volrend, name) for name in ("pack_info", "exclusive_prod")}

    def pack_info(ray_indices: Any, n_rays: int) -> Any:
        """Where each ray's samples start, and how many there are."""
        counts = torch.bincount(ray_indices, minlength=n_rays)
        return torch.stack([counts.cumsum(0) - counts, counts], -1)

    def exclusive_prod(values: Any, packed_info: Any) -> Any:
        """Of each sample: the product of those before it on its ray."""
        starts, counts = packed_info.unbind(-1)
        logs = values.double().log()  # the running sum over millions of pairs outgrows float32
        before = logs.cumsum(0) - logs
        first = before[starts.clamp(max=len(values) - 1)]
        return (before - first.repeat_interleave(counts)).exp().float()

    volrend.pack_info, volrend.exclusive_prod = pack_info, exclusive_prod
    try:
        yield
    finally:
        for name, original in originals.items():
            setattr(volrend, name, original)
