"""Ways in which heads differ: each mode a smooth field of displacements, one standard deviation at 1."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cap4d.rig.builtin.field import EYE
from cap4d.rig.builtin.sheet import Mesh, smoothstep

Field = Callable[[np.ndarray], np.ndarray]


def _front(p: np.ndarray) -> np.ndarray:
    return smoothstep(5, 45, p[:, 2])


def _near(p: np.ndarray, centre: tuple, size: tuple) -> np.ndarray:
    """[N] Gaussian about a centre on the left and its mirror image."""
    q = np.stack([np.abs(p[:, 0]), p[:, 1], p[:, 2]], -1)
    return np.exp(-(((q - centre) / size) ** 2).sum(1))


def _above_shirt(p: np.ndarray) -> np.ndarray:
    return smoothstep(-190, -120, p[:, 1])


def _along(
    x: np.ndarray | float, y: np.ndarray | float, z: np.ndarray | float, share: np.ndarray
) -> np.ndarray:
    return np.stack(np.broadcast_arrays(x, y, z), -1) * share[:, None]


def _side(p: np.ndarray) -> np.ndarray:
    """Sign of x, softened over the nose's width."""
    return np.tanh(p[:, 0] / 8)


FIELDS: dict[str, Field] = {
    "head_width": lambda p: _along(0.035 * p[:, 0], 0, 0, _above_shirt(p)),
    "head_height": lambda p: _along(0, 1, 0, 6.0 * smoothstep(25, 130, p[:, 1])),
    "head_depth": lambda p: _along(0, 0, 0.035 * p[:, 2], _above_shirt(p)),
    "face_length": lambda p: _along(0, -1, 0, 4.5 * smoothstep(15, -100, p[:, 1])),
    "jaw_width": lambda p: _along(
        0.07 * p[:, 0],
        0,
        0,
        smoothstep(0, -55, p[:, 1]) * smoothstep(-130, -95, p[:, 1]) * smoothstep(-45, 10, p[:, 2]),
    ),
    "chin_length": lambda p: _along(0, -1, 0.15, 3.6 * _near(p, (0, -98, 66), (30, 22, 34))),
    "chin_forward": lambda p: _along(0, 0, 1, 3.2 * _near(p, (0, -90, 76), (26, 22, 34))),
    "nose_size": lambda p: (p - [0, -8, 82]) * (0.11 * _near(p, (0, -12, 95), (17, 24, 22)))[:, None],
    "nose_length": lambda p: _along(0, -1, 0.3, 2.6 * _near(p, (0, -22, 98), (14, 16, 20))),
    "nose_width": lambda p: _along(_side(p), 0, 0, 2.6 * _near(p, (13, -22, 90), (9, 11, 14))),
    "nose_bridge": lambda p: _along(0, 0, 1, 2.3 * _near(p, (0, 10, 90), (8, 17, 18))),
    "nose_tip_up": lambda p: _along(0, 1, 0.2, 2.2 * _near(p, (0, -17, 108), (12, 10, 14))),
    "eye_spacing": lambda p: _along(_side(p), 0, 0, 1.7 * _near(p, (32, 20, 66), (24, 20, 30))),
    "eye_height": lambda p: _along(0, 1, 0, 2.0 * _near(p, (32, 22, 66), (28, 22, 34))),
    "eye_depth": lambda p: _along(0, 0, -1, 1.6 * _near(p, (33, 22, 68), (24, 18, 30))),
    "mouth_width": lambda p: _along(0.11 * p[:, 0], 0, 0, _near(p, (0, -54, 84), (38, 17, 34))),
    "mouth_height": lambda p: _along(0, 1, 0, 2.0 * _near(p, (0, -54, 84), (36, 17, 40))),
    "cheek_fullness": lambda p: _along(
        1.0 * _side(p), -0.1, 0.6, 3.2 * _near(p, (44, -38, 46), (22, 27, 30))
    ),
    "cheekbones": lambda p: _along(0.8 * _side(p), 0.2, 0.7, 3.6 * _near(p, (50, -8, 52), (20, 16, 26))),
    "brow_ridge": lambda p: _along(0, -0.3, 1, 1.9 * _near(p, (22, 40, 80), (30, 9, 22))),
    "brow_height": lambda p: _along(0, 1, 0, 2.2 * _near(p, (28, 42, 78), (32, 9, 26))),
    "forehead_slope": lambda p: _along(0, 0, -1, 4.0 * smoothstep(42, 110, p[:, 1]) * _front(p)),
    "ear_size": lambda p: (
        (p - np.stack([68 * np.sign(p[:, 0]), 0 * p[:, 1], 0 * p[:, 2] - 8], -1))
        * (0.10 * _near(p, (77, 2, -14), (13, 38, 22)))[:, None]
    ),
    "ear_stand": lambda p: _along(
        np.sign(p[:, 0]), 0, 0, 3.0 * smoothstep(-4, -26, p[:, 2]) * _near(p, (82, 4, -22), (12, 30, 18))
    ),
    "neck_width": lambda p: _along(
        0.06 * p[:, 0],
        0,
        0.06 * (p[:, 2] + 35),
        smoothstep(-75, -125, p[:, 1]) * smoothstep(-210, -160, p[:, 1]),
    ),
    "lip_fullness": lambda p: _along(
        0, 0.2 * (p[:, 1] + 53.5), 1.9, _near(p, (0, -54, 90), (22, 10.5, 16)) * _front(p)
    ),
}
EYE_SCALE, EYE_TILT = 0.055, 0.08  # of the two modes about the eyeball's centre; the tilt in rad


def _own_eye(p: np.ndarray) -> np.ndarray:
    """[N, 3] the centre of the eyeball on each point's side."""
    return EYE * np.where(p[:, :1] < 0, [-1, 1, 1], [1, 1, 1])


def carried(field: Field, p: np.ndarray, ball: np.ndarray) -> np.ndarray:
    """The field with each eyeball, and the lids that lie on it, carried along rigidly.

    Args:
        p: [N, 3] mm.
        ball: bool[N] points of the eyeballs.
    """
    centre = _own_eye(p)
    rigid = np.where(ball, 1, smoothstep(30, 20, np.linalg.norm(p - centre, axis=1)))[:, None]
    at_eye = field(np.stack([EYE, EYE * [-1, 1, 1]]))
    return (1 - rigid) * field(p) + rigid * np.where(p[:, :1] < 0, at_eye[1], at_eye[0])


def _about_eye(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[N, 3] from the centre of the eye on the point's side, and [N] 1 on ball and lids, 0 beyond."""
    arm = p - _own_eye(p)
    return arm, smoothstep(38, 20, np.linalg.norm(arm, axis=1))


def eye_size(p: np.ndarray, ball: np.ndarray) -> np.ndarray:
    """[N, 3] the ball and its lids grow."""
    arm, share = _about_eye(p)
    return EYE_SCALE * arm * share[:, None]


def eye_tilt(p: np.ndarray, ball: np.ndarray) -> np.ndarray:
    """[N, 3] the lids turn about the gaze, outer corners up; the ball, round as it is, stays."""
    arm, share = _about_eye(p)
    angle = EYE_TILT * share * np.sign(p[:, 0]) * ~ball
    return angle[:, None] * np.stack([-arm[:, 1], arm[:, 0], 0 * angle], -1)


def identity_modes(mesh: Mesh, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """[S, V, 3] and [S, J, 3] mm, and the S names."""
    modes = {name: lambda p, ball, field=field: carried(field, p, ball) for name, field in FIELDS.items()}
    modes |= {"eye_size": eye_size, "eye_tilt": eye_tilt}
    ball, none = mesh.of("eye"), np.zeros(len(joints), bool)
    on_mesh = [mode(mesh.points, ball) for mode in modes.values()]
    return np.stack(on_mesh), np.stack([mode(joints, none) for mode in modes.values()]), tuple(modes)
