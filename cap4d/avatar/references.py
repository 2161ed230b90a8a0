"""Which images of a capture an avatar is made from, and which cameras it never sees.

The paper's protocols fit to 1, 10 and 100 reference images and look at cameras that were held out (fact 74).
References are chosen by what is known before any fit: head pose, camera, expression and gaze.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from cap4d.avatar.presets import Preset
from cap4d.avatar.views import Split, load_views, split_views, spread
from cap4d.capture.capture import Capture, View, read_listing
from cap4d.errors import ArgumentError, DataError
from cap4d.rig.head import HeadRig

FRONT = np.array([0.0, 0.0, -1.0])  # where the face looks, head-fixed OpenCV axes
FRONTAL_DEG = 75.0  # a camera within this of the front sees a face
CHORD = 0.5  # between directions 29 degrees apart: a turn that matters as much as a usual expression
GAZE_UNIT = 0.35  # rad, likewise
FEW_EPS = 1e-5  # of Adam, for a single image; a visible Gaussian's gradients are about 1e-6
MOST_HELD_OUT = 24  # images that a fit's own report looks at


@dataclass(frozen=True)
class Selection:
    """What is trained on, of the first capture.

    Args:
        references: (camera, frame) of the images; None: all that nothing else holds out.
        hold_out: Cameras never trained on.
    """

    references: tuple[tuple[str, int], ...] | None = None
    hold_out: tuple[str, ...] = ()


def select(
    capture: Capture, references: Sequence[tuple[str, int]] | None, hold_out: Iterable[str]
) -> Selection | None:
    """A checked selection; None where everything is as usual.

    Raises:
        ArgumentError: No such camera or image, an image named twice, or one of a held-out camera.
    """
    hold_out = tuple(hold_out)
    for name in hold_out:
        if name not in capture.cameras:
            raise ArgumentError(f"hold_out: expected cameras of {capture.path}, got {name!r}")
    if references is None:
        return Selection(None, hold_out) if hold_out else None
    chosen = tuple((str(camera), int(frame)) for camera, frame in references)
    known = {(v.camera, v.frame) for v in capture.views}
    for pair in chosen:
        if pair not in known or pair[0] in hold_out:
            raise ArgumentError(
                f"references: expected images of {capture.path} that no camera holds out, got {pair}"
            )
    if not chosen or len(set(chosen)) != len(chosen):
        raise ArgumentError(f"references: expected distinct images, at least one, got {len(chosen)}")
    return Selection(chosen, hold_out)


def read_references(path: Path, capture: Capture) -> list[tuple[str, int]]:
    """A list of [camera, frame] in a JSON file laid out as reference_images.json.

    Raises:
        DataError: It is not such a list, or names what the capture lacks.
    """
    if not path.is_file():
        raise DataError(path, "file", expected="JSON", found="no file")
    return read_listing(path, capture.cameras, len(capture))


def choose_references(
    capture: Capture, rig: HeadRig, count: int, *, hold_out: Iterable[str] = (), seed: int = 0
) -> list[tuple[str, int]]:
    """References in the order of their worth: those for a smaller count are the first of those for a greater.

    The first is the most frontal, calm one. Each next one is that which brings the view directions of all
    images, and apart from them their faces (expression and gaze), nearest to those of a chosen image (greedy
    medoids): a side need not be seen with every expression.
    Args:
        hold_out: Cameras to leave alone.
        seed: 0 chooses from all images, any other from a random half of them.
    Raises:
        ArgumentError: Fewer images than `count`, or a count that is not positive.
    """
    hold_out = set(hold_out)
    views = [v for v in capture.views if v.camera not in hold_out and not _is_marked(capture, v)]
    if seed:
        half = np.random.default_rng(seed).permutation(len(views))[: max(count, (len(views) + 1) // 2)]
        views = [views[i] for i in np.sort(half)]
    if not 1 <= count <= len(views):
        raise ArgumentError(f"references: expected 1 to {len(views)}, got {count}")
    directions, faces = _directions(capture, views), _faces(capture, rig, views)
    first = int(np.argmin(np.linalg.norm(directions - FRONT, axis=1) / CHORD + np.linalg.norm(faces, axis=1)))
    order = _medoids([directions, faces], first, count)
    return [(views[i].camera, views[i].frame) for i in order]


def choose_held_out(capture: Capture, count: int) -> tuple[str, ...]:
    """Names of `count` cameras, evenly from side to side among those that see the face.

    Raises:
        ArgumentError: The capture has no camera in front beside them to train on.
    """
    yaw = {name: _mean_direction(capture, name) for name in capture.cameras}
    seen = {
        name: d for name, d in yaw.items() if d is not None and d @ FRONT > np.cos(np.radians(FRONTAL_DEG))
    }
    order = sorted(seen, key=lambda name: float(np.arctan2(seen[name][0], -seen[name][2])))
    if not 0 <= count < max(1, len(order)):
        raise ArgumentError(f"hold_out_cameras: expected fewer than the {len(order)} in front, got {count}")
    return tuple(order[int((i + 0.5) * len(order) / count)] for i in range(count))


def suited(preset: Preset, count: int) -> Preset:
    """The short recipe's preset for a fit to `count` images; other recipes are what they say.

    Adam takes full steps along any gradient that keeps its sign, however small. With few images that of a
    Gaussian which shines through others does: it takes on whatever colour mends the last digit of these
    images, and shows it where it is seen from elsewhere. A larger eps leaves it almost alone: steps go with
    the gradient where that is below eps. Ten images settle it themselves (1e-7 for 1e-8 costs them 0.1 dB).
    """
    if preset.recipe != "short":
        return preset
    eps = max(preset.rates.gaussian_eps, FEW_EPS / count**3)
    return replace(preset, rates=replace(preset.rates, gaussian_eps=eps))


def split_selected(captures: Sequence[Capture], selection: Selection, image_size: int) -> Split:
    """Loads and splits the views: the selection of the first capture, the usual split of the others.

    Held out are the cameras that the selection holds out, else what the capture marks, else what is left,
    at most `MOST_HELD_OUT` of them, evenly.
    """
    first, others = captures[0], captures[1:]
    train, held_out = _sides(first, selection)
    if not train:
        raise ArgumentError("references: expected an image that is not held out, found none")
    held_out = spread(held_out, MOST_HELD_OUT) if held_out else []
    views = load_views([replace(first, views=(*train, *held_out)), *others], image_size)
    seen, unseen = views[0][: len(train)], views[0][len(train) :]
    tail = [False] * len(unseen)
    if others:
        # Generated views support the references; what is judged stays with the person's own images.
        rest = split_views(captures, [[], *views[1:]])
        seen = [*seen, *rest.train]
    return Split(tuple(seen), tuple(unseen), np.array(tail, bool))


def _sides(capture: Capture, selection: Selection) -> tuple[list[View], list[View]]:
    apart = [v for v in capture.views if v.camera in selection.hold_out]
    free = [v for v in capture.views if v.camera not in selection.hold_out]
    marked = [v for v in free if _is_marked(capture, v)]
    if selection.references is None:
        return [v for v in free if not _is_marked(capture, v)], apart or marked
    by_name = {(v.camera, v.frame): v for v in free}
    chosen = set(selection.references)
    left = [v for v in free if (v.camera, v.frame) not in chosen]
    return [by_name[pair] for pair in selection.references], apart or marked or left


def _is_marked(capture: Capture, view: View) -> bool:
    return capture.held_out is not None and bool(capture.held_out[view.frame])


def _medoids(places: Sequence[np.ndarray], first: int, count: int) -> list[int]:
    """Indices of `count` rows, each the one that lowers the distances of all to the nearest most.

    Args:
        places: float64[N, D] per aspect; the aspects count alike.
    """
    apart = [cdist(p, p) for p in places]
    apart = [a / max(float(a[first].mean()), 1e-12) for a in apart]
    nearest, order = [a[first].copy() for a in apart], [first]
    while len(order) < count:
        gains = sum(np.maximum(n - a, 0).sum(1) for a, n in zip(apart, nearest, strict=True))
        gains[order] = -1  # of two images alike to the last bit, neither is taken twice
        order.append(int(np.argmax(gains)))
        nearest = [np.minimum(n, a[order[-1]]) for a, n in zip(apart, nearest, strict=True)]
    return order


def _faces(capture: Capture, rig: HeadRig, views: Sequence[View]) -> np.ndarray:
    """float64[N, E + 3]: expression and gaze, in units that matter about alike."""
    frames = np.array([v.frame for v in views])
    # An expression weighs what it moves, so that rigs with many small components are not ruled by them.
    moves = np.sqrt(np.square(rig.expression_basis.astype(np.float64)).sum((1, 2)))
    expr = capture.expr[frames] * moves
    usual = np.sqrt(2 * np.square(expr - expr.mean(0)).sum(1).mean())
    return np.concatenate([expr / max(usual, 1e-12), capture.eye_rot[frames] / GAZE_UNIT], 1)


def _directions(capture: Capture, views: Sequence[View]) -> np.ndarray:
    """float64[N, 3], see `_direction`."""
    return np.stack([_direction(capture, v) for v in views])


def _direction(capture: Capture, view: View) -> np.ndarray:
    """[3] unit vector from the head to the camera, head-fixed OpenCV axes."""
    viewmat = capture.head_camera(view).viewmat
    position = -viewmat[:3, :3].T @ viewmat[:3, 3]
    return position / np.linalg.norm(position)


def _mean_direction(capture: Capture, camera: str) -> np.ndarray | None:
    """The same, mean over a camera's images; None where it has none."""
    found = [_direction(capture, v) for v in capture.views if v.camera == camera]
    return np.mean(found, 0) / np.linalg.norm(np.mean(found, 0)) if found else None
