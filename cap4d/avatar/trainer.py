"""One optimisation step at a time: render a view, compare, step Adam, and now and then densify.

All randomness is a function of the seed and the step, so a resumed fit repeats an uninterrupted one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import nn

from cap4d.avatar.densify import Evidence, Rows, densify, reset_opacity
from cap4d.avatar.losses import (
    Distance,
    axis_position_loss,
    laplacian_loss,
    photometric,
    position_loss,
    relative_deformation_loss,
    relative_rotation_loss,
    scale_loss,
)
from cap4d.avatar.model import AvatarModel, Deformation, Posed
from cap4d.avatar.presets import Preset
from cap4d.avatar.views import FitView, spread
from cap4d.avatar.worth import removal_errors
from cap4d.bind import triangle_frames
from cap4d.camera import opencv_from_rig
from cap4d.errors import Cap4dError
from cap4d.raster import Rasterized, rasterize
from cap4d.raster.rasterize import Backend

WHITE = (1.0, 1.0, 1.0)
ADAM_EPS = 1e-15  # fact 36; gradients of a mean over pixels are tiny
WORTH_VIEWS = 12  # that are asked which Gaussians they would miss


class Trainer:
    """An avatar, the corrections of its captures, and the optimiser of both.

    Args:
        model: What is fitted.
        corrections: One per capture: `Corrections`, `NeckOffsets` or `Uncorrected`.
        views: Training views.
        preset: Schedule, rates and weights.
        seed: Of the order of views and of densification.
        perceptual: What `preset.perceptual` compares images by; None leaves the term out.
        backend: Of `rasterize`.
    """

    def __init__(
        self,
        model: AvatarModel,
        corrections: Sequence[nn.Module],
        views: Sequence[FitView],
        preset: Preset,
        *,
        seed: int,
        perceptual: Distance | None = None,
        backend: Backend = "auto",
    ) -> None:
        self.backend = backend
        self.model, self.preset, self.views, self.seed = model, preset, views, seed
        self.corrections, self.perceptual = nn.ModuleList(corrections), perceptual
        self.step = 0
        self.evidence = Evidence(len(model), self.device)
        self.optimizer = _optimizer(model, self.corrections, preset)
        self.rows = Rows(model, self.optimizer)
        neutral = opencv_from_rig(model.subject.neutral)
        self.faces = model.faces.long()
        self.face_sizes = triangle_frames(neutral, self.faces)[2]

    @property
    def device(self) -> torch.device:
        """Where everything is but the views."""
        return self.model.binding.device

    def move(self, device: torch.device) -> None:
        """Takes everything that a step touches to a device."""
        if device == self.device:
            return
        state = self.state()
        self.model.to(device)
        self.corrections.to(device)
        self.views = [view.to(device) for view in self.views]
        self.faces, self.face_sizes = self.faces.to(device), self.face_sizes.to(device)
        self.restore(state)

    def advance(self) -> float:
        """Takes one step and returns its loss.

        Raises:
            Cap4dError: The loss is not finite; no parameter was changed.
        """
        self._set_rates()
        view = self.views[self._view_index()]
        posed, rendered = self.render(view, noise=self.preset.expression_noise)
        loss = self._loss(view, posed, rendered)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        value = loss.item()
        if not math.isfinite(value):
            raise Cap4dError(
                f"step {self.step}: the loss is {value} in frame {view.frame} of capture {view.capture + 1}"
            )
        self.evidence.add(rendered.means2d.grad, rendered.radii)
        self.optimizer.step()
        self.step += 1
        self._refine()
        return value

    def render(self, view: FitView, *, noise: float = 0.0) -> tuple[Posed, Rasterized]:
        """The avatar as it should look in a view, with the corrections of its frame.

        Args:
            noise: Standard deviation of what is added to the expression that the network sees, rig units.
        """
        posed = self._posed(view, noise=noise)
        rendered = rasterize(
            posed.means,
            posed.quats,
            posed.scales,
            posed.opacities,
            posed.sh,
            camera=view.camera,
            background=WHITE,
            sh_degree=self.sh_degree,
            backend=self.backend,
        )
        return posed, rendered

    def _posed(self, view: FitView, *, noise: float = 0.0) -> Posed:
        corrected = self.corrections[view.capture].at(view.frame)
        pose = seen = corrected.pose
        if noise > 0:
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.step)
            jitter = noise * torch.randn(pose.expr.shape, generator=generator).to(pose.expr)
            seen = replace(pose, expr=pose.expr.detach() + jitter)
        return self.model.pose(pose, rigid=corrected.rigid, network_pose=seen)

    @property
    def sh_degree(self) -> int:
        """Harmonics come in one degree at a time (fact 37)."""
        return min(self.preset.sh_degree, self.step // self.preset.sh_every)

    def _loss(self, view: FitView, posed: Posed, rendered: Rasterized) -> torch.Tensor:
        w, local = self.preset.weights, self.model.gaussians
        visible = rendered.radii > 0
        loss = self._photometric(rendered.rgb, view.target)
        if view.coverage is not None and w.matte > 0:
            loss = loss + w.matte * (rendered.alpha - view.coverage.float()).abs().mean()
        stray = position_loss if w.measures == "released" else axis_position_loss
        loss = loss + w.position * stray(local["means"], visible, w.position_limit)
        loss = loss + w.scale * scale_loss(local["log_scales"], visible, w.scale_limit)
        loss = loss + w.pose * self.corrections[view.capture].penalty(view.frame)
        if posed.deformation is not None:
            for term in self._deformation_terms(posed.surface, posed.deformation):
                loss = loss + term
        return loss

    def _deformation_terms(self, surface: torch.Tensor, d: Deformation) -> Iterator[torch.Tensor]:
        """What the network pays in this step (fact 35)."""
        w, every = self.preset.weights, self.preset.rotation_every
        if w.measures == "released":
            yield w.laplacian * laplacian_loss(self.model.moving_map(d)[None])
            riders = (self.model.riding(surface + x)[0] for x in (d.moved, d.neutral))
            yield w.deformation * relative_deformation_loss(*riders)
        else:
            yield w.laplacian * laplacian_loss(d.maps)
            yield w.deformation * relative_deformation_loss(d.moved, d.neutral)
        if self.step % every == 0:
            yield every * w.rotation * rotation_term(surface, d.moved, d.neutral, self.faces)

    def _photometric(self, image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """The mixture of L1 and SSIM, less and less of it as the perceptual distance comes in (fact 33)."""
        loss, p = photometric(image, target, self.preset.weights), self.preset.perceptual
        share = p.share(self.step)
        if self.perceptual is None or share == 0:
            return loss
        return share * p.weight * self.perceptual(image, target) + (1 - share) * loss

    def _refine(self) -> None:
        d = self.preset.densify
        if d.grows_at(self.step):
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.step)
            densify(
                self.rows,
                self.evidence,
                d,
                face_sizes=self.face_sizes,
                step=self.step,
                room=self._room(),
                per_face=self.preset.per_face,
                generator=generator,
                worth=self._worth(generator) if d.prune_least > 0 else None,
            )
            self.evidence = Evidence(len(self.model), self.device)
        if d.resets_at(self.step):
            reset_opacity(self.rows)

    def _worth(self, generator: torch.Generator) -> torch.Tensor:
        views = spread(self.views, WORTH_VIEWS)
        return removal_errors(self._posed, views, sh_degree=self.sh_degree, generator=generator)

    def _room(self) -> int | None:
        """An even share of the growth that is left: early rounds know least about where detail is missing."""
        d = self.preset.densify
        if d.most is None:
            return None
        rounds = (d.stop - self.step) // d.every + 1
        return math.ceil((d.most - len(self.model)) / rounds)

    def _view_index(self) -> int:
        """Every view once per epoch, in an order that depends on nothing but seed and epoch."""
        epoch, position = divmod(self.step, len(self.views))
        return int(np.random.default_rng([self.seed, epoch]).permutation(len(self.views))[position])

    def _set_rates(self) -> None:
        t = self.step / max(1, self.preset.iterations)
        for group in self.optimizer.param_groups:
            first, last = group["ends"]
            group["lr"] = math.exp((1 - t) * math.log(first) + t * math.log(last))

    # checkpoint ------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything a resumed fit needs: tensors, and plain numbers and lists."""
        return {
            "step": self.step,
            "seed": self.seed,
            "gaussians": {name: value.detach() for name, value in self.model.gaussians.items()},
            "binding": self.model.binding,
            "deformer": {} if self.model.deformer is None else self.model.deformer.state_dict(),
            "corrections": self.corrections.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "evidence": [self.evidence.gradient, self.evidence.seen, self.evidence.radius],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Takes up a `state`. Its sizes must be those of this trainer but for the number of Gaussians.

        Raises:
            ValueError, KeyError, RuntimeError: They are not. The trainer is of no use then.
        """
        self._check_rows(state)
        self.step = state["step"]
        for name, value in state["gaussians"].items():
            self.model.gaussians[name] = nn.Parameter(value.to(self.device))
        self.model.binding = state["binding"].to(self.device)
        if self.model.deformer is not None:
            self.model.deformer.load_state_dict(state["deformer"])
        self.corrections.load_state_dict(state["corrections"])
        self.optimizer = _optimizer(self.model, self.corrections, self.preset)
        self.optimizer.load_state_dict(state["optimizer"])
        self.rows = Rows(self.model, self.optimizer)
        self.evidence = Evidence(len(self.model), self.device)
        self.evidence.gradient, self.evidence.seen, self.evidence.radius = (
            x.to(self.device) for x in state["evidence"]
        )

    def _check_rows(self, state: dict[str, Any]) -> None:
        """That every Gaussian has all its values and a triangle there is."""
        binding = state["binding"]
        n, triangles = len(binding), len(self.faces)
        if binding.dtype != torch.int32 or n == 0 or not 0 <= binding.min() <= binding.max() < triangles:
            raise ValueError(f"binding: expected int32[N] below {triangles}")
        rows = {name: (n, *value.shape[1:]) for name, value in self.model.gaussians.items()}
        found = {name: tuple(state["gaussians"][name].shape) for name in rows}
        if found != rows or any(x.shape != (n,) for x in state["evidence"]):
            raise ValueError(f"gaussians: expected {rows}, got {found}")


def rotation_term(
    surface: torch.Tensor, moved: torch.Tensor, neutral: torch.Tensor, faces: torch.Tensor
) -> torch.Tensor:
    """How far the deformation turns the triangles beyond what it does to them at rest (fact 35).

    In double: torch sums float gradients of gathered vertices in an order that depends on its threads.
    """
    turned, still = (triangle_frames((surface + x).double(), faces)[1] for x in (moved, neutral))
    return relative_rotation_loss(turned, still)


def _optimizer(model: AvatarModel, corrections: nn.ModuleList, preset: Preset) -> torch.optim.Adam:
    r = preset.rates
    ends = {
        "means": r.means,
        "sh_dc": r.sh_dc,
        "sh_rest": r.sh_rest,
        "opacity_logits": r.opacity,
        "log_scales": r.scale,
        "quats": r.rotation,
    }
    groups: list[dict[str, Any]] = [
        {"params": [model.gaussians[n]], "ends": e, "eps": r.gaussian_eps}
        for n, e in ends.items()
        if model.gaussians[n].numel()
    ]
    if corrected := list(corrections.parameters()):
        groups.append({"params": corrected, "ends": r.correction, "eps": r.correction_eps})
    if model.deformer is not None:
        decay = r.deformer_decay
        groups.append(
            {"params": list(model.deformer.parameters()), "ends": r.deformer, "weight_decay": decay}
        )
    return torch.optim.Adam(groups, lr=1e-3, eps=ADAM_EPS, fused=True)
