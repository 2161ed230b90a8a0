"""Growing and thinning the Gaussians while they are fitted (facts 30, 37; Kerbl et al. 2023, sec. 5.2).

Everything here is a row operation: choose rows, make new ones, keep others. `Rows` carries it out on
parameters, the binding and Adam's state alike, so that they stay aligned.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import nn

from cap4d.avatar.model import AvatarModel
from cap4d.avatar.presets import Densify
from cap4d.rotation import quat_to_rotmat

RESET_OPACITY = 0.01
SPLIT_SHRINK = 1.6  # 0.8 x 2 children (Kerbl et al. 2023)
CHILDREN = 2


class Evidence:
    """What the views said about each of N Gaussians since the last densification.

    Attributes:
        gradient: [N] sum of the norms of dL/d(means2d), px^-1.
        seen: [N] views it was visible in.
        radius: [N] largest radius on screen, px.
    """

    def __init__(self, n: int, device: torch.device | None = None) -> None:
        self.gradient, self.seen, self.radius = (torch.zeros(n, device=device) for _ in range(3))

    def add(self, v_means2d: torch.Tensor, radii: torch.Tensor) -> None:
        """Adds one view: dL/d(means2d) [N, 2] and radii [N], 0 where not visible."""
        visible = radii > 0
        self.gradient += v_means2d.norm(dim=1) * visible
        self.seen += visible
        self.radius = torch.maximum(self.radius, radii.float())

    def mean_gradient(self) -> torch.Tensor:
        return self.gradient / self.seen.clamp(min=1)


class Rows:
    """The Gaussians of a model as a table, together with the optimiser that updates them."""

    def __init__(self, model: AvatarModel, optimizer: torch.optim.Optimizer) -> None:
        self.model, self.optimizer = model, optimizer

    def keep(self, rows: torch.Tensor) -> None:
        """Keeps rows (bool[N] or int64[K]) of every parameter, of Adam's moments and of the binding."""
        self._rewrite(lambda _, value: value[rows], lambda value: value[rows])
        self.model.binding = self.model.binding[rows]

    def append(self, new: dict[str, torch.Tensor], binding: torch.Tensor) -> None:
        """Adds rows; their moments start at zero."""
        k = len(binding)
        self._rewrite(
            lambda name, value: torch.cat([value, new[name]]),
            lambda value: torch.cat([value, value.new_zeros(k, *value.shape[1:])]),
        )
        self.model.binding = torch.cat([self.model.binding, binding])

    def overwrite(self, name: str, value: torch.Tensor) -> None:
        """Replaces one parameter and forgets its moments."""
        self._rewrite(lambda n, old: value if n == name else old, None, only=name)

    def _rewrite(self, parameter_map, moment_map, *, only: str | None = None) -> None:
        for name, old in list(self.model.gaussians.items()):
            if only not in (None, name):
                continue
            new = nn.Parameter(parameter_map(name, old.detach()))
            state = self.optimizer.state.pop(old, {})
            for key in ("exp_avg", "exp_avg_sq"):
                if key in state:
                    state[key] = torch.zeros_like(new) if moment_map is None else moment_map(state[key])
            for group in _groups_of(self.optimizer, old):
                group["params"] = [new if p is old else p for p in group["params"]]
            if state:
                self.optimizer.state[new] = state
            self.model.gaussians[name] = new


def densify(
    rows: Rows,
    evidence: Evidence,
    settings: Densify,
    *,
    face_sizes: torch.Tensor,
    step: int,
    room: int | None,
    per_face: int,
    generator: torch.Generator,
    worth: torch.Tensor | None = None,
) -> None:
    """One round: clone small and split large Gaussians that views pull at, prune faint and huge ones.

    Args:
        evidence: Since the last round.
        room: How many more Gaussians there may be after this round; those with the largest gradients are
            refined. None: any number.
        face_sizes: [M] m (fact 27), which turn local scales into world scales.
        per_face: Triangles keep at least one Gaussian if this is at least 1 (fact 30).
        worth: [N] what the training views would lose with each (see `removal_errors`). The share
            `prune_least` that is worth least goes; it makes room for as many.
    """
    n = len(rows.model)
    world = rows.model.gaussians["log_scales"].detach().exp().amax(1) * face_sizes[rows.model.binding]
    needless = torch.zeros_like(world, dtype=torch.bool)
    if worth is not None:
        needless[worth.topk(int(settings.prune_least * n), largest=False).indices] = True
    if per_face >= 1:
        needless &= ~_last_of_their_face(needless, rows.model, len(face_sizes))
    freed = None if room is None else room + int(needless.sum())
    chosen = _most_wanted(evidence.mean_gradient(), settings.gradient, freed) & ~needless
    split = chosen & (world > settings.split_scale)
    _clone(rows, chosen & ~split)
    _split(rows, split, face_sizes if settings.split_offset == "world" else None, generator)
    doomed = rows.model.gaussians["opacity_logits"].detach().sigmoid() < settings.prune_opacity
    doomed[:n] |= split | needless  # their children replace those that were split
    if step > settings.prune_big_after:
        doomed[:n] |= (evidence.radius > settings.prune_radius) | (world > settings.prune_scale)
    keep = ~doomed
    if per_face >= 1:
        keep |= _last_of_their_face(doomed, rows.model, len(face_sizes))
    rows.keep(keep)


def reset_opacity(rows: Rows) -> None:
    """Lowers every opacity to at most 0.01, so that those nobody needs fade (Kerbl et al. 2023, sec. 5.2)."""
    ceiling = torch.tensor(RESET_OPACITY, device="cpu").logit().item()
    rows.overwrite("opacity_logits", rows.model.gaussians["opacity_logits"].detach().clamp(max=ceiling))


def _most_wanted(gradient: torch.Tensor, threshold: float, room: int | None) -> torch.Tensor:
    """bool[N]: above the threshold, and among the `room` largest."""
    wanted = gradient > threshold
    if room is None or int(wanted.sum()) <= room:
        return wanted
    chosen = torch.zeros_like(wanted)
    if room > 0:
        chosen[gradient.topk(room).indices] = True
    return chosen & wanted


def _clone(rows: Rows, chosen: torch.Tensor) -> None:
    """Copies small Gaussians; the optimiser pulls the two apart."""
    copies = {name: value.detach()[chosen] for name, value in rows.model.gaussians.items()}
    rows.append(copies, rows.model.binding[chosen])


def _split(
    rows: Rows, chosen: torch.Tensor, offset_sizes: torch.Tensor | None, generator: torch.Generator
) -> None:
    """Replaces large Gaussians by two samples of themselves, 1.6 times smaller.

    The samples are drawn at the Gaussian's local scale, or at `offset_sizes` [M] times that of its face: face
    sizes make that the world scale, which the released code adds to local coordinates (fact 30).
    """
    # `chosen` speaks of the rows before cloning appended to them.
    index = chosen.nonzero()[:, 0].repeat(CHILDREN)
    children = {name: value.detach()[index].clone() for name, value in rows.model.gaussians.items()}
    noise = torch.randn(len(index), 3, generator=generator, device=generator.device).to(index.device)
    noise *= children["log_scales"].exp()
    if offset_sizes is not None:
        noise *= offset_sizes[rows.model.binding[index], None]
    children["means"] += (quat_to_rotmat(children["quats"]) @ noise[:, :, None])[:, :, 0]
    children["log_scales"] -= torch.tensor(SPLIT_SHRINK, device="cpu").log().item()
    rows.append(children, rows.model.binding[index])


def _last_of_their_face(doomed: torch.Tensor, model: AvatarModel, faces: int) -> torch.Tensor:
    """bool[N]: the most opaque doomed Gaussian of every face that would lose all of its own."""
    survivors = torch.bincount(model.binding[~doomed], minlength=faces)
    at_risk = (doomed & (survivors[model.binding] == 0)).nonzero()[:, 0]
    opacity = model.gaussians["opacity_logits"].detach()[at_risk]
    order = at_risk[torch.sort(opacity, stable=True).indices]
    place = torch.arange(len(order), device=order.device)
    rank = torch.full((faces,), -1, device=order.device).scatter_reduce(
        0, model.binding[order].long(), place, "amax"
    )
    saved = torch.zeros_like(doomed)
    saved[order[rank[rank >= 0]]] = True
    return saved


def _groups_of(optimizer: torch.optim.Optimizer, parameter: torch.Tensor) -> Iterator[dict]:
    groups: Iterable[dict] = optimizer.param_groups
    return (group for group in groups if any(p is parameter for p in group["params"]))
