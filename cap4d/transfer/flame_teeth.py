"""The teeth that GaussianAvatars adds to FLAME: two bent bars behind the lips, 120 vertices, 168 triangles.

Gaussians are bound to triangles by number, and their frames begin at a triangle's first vertex, so order and
starting corners are the published system's; its weights, basis and numbers are needed to pose what it fitted.
"""

from __future__ import annotations

import numpy as np

from cap4d.rig.flame import N_FILE_IDENTITY, FlameModel

# The outer rims of FLAME's lips from the person's left to the right. A column of teeth is behind each pair.
UPPER_RIM = [1713, 1715, 1716, 1735, 1696, 1694, 1657, 3543, 2774, 2811, 2813, 2850, 2833, 2832, 2830]
LOWER_RIM = [1576, 1577, 1773, 1774, 1795, 1802, 1865, 3503, 2948, 2905, 2898, 2881, 2880, 2713, 2712]
COLUMNS = len(UPPER_RIM)

# Rows of vertices in their order: the jaw they belong to, and how far up and back from the middle of the
# mouth they lie, in units of the mean distance of the rims.
ROWS = {
    "upper_root": ("upper", 2.1, 1.5),
    "lower_root": ("lower", -2.1, 1.9),
    "upper_edge": ("upper", 0.1, 1.5),
    "lower_edge": ("lower", -0.1, 1.9),
    "upper_root_back": ("upper", 2.1, 2.5),
    "upper_edge_back": ("upper", 0.1, 2.5),
    "lower_root_back": ("lower", -2.1, 2.9),
    "lower_edge_back": ("lower", -0.1, 2.9),
}
N_TEETH = len(ROWS) * COLUMNS
JAWS = {"upper": 1, "lower": 2}  # FLAME's joints that move them: the neck carries the head

# Both triangles of a quad between two rows: corners 0 and 1 are of the first row, 2 and 3 below them.
ALONG, ACROSS = ((0, 3, 2), (0, 1, 3)), ((0, 1, 2), (1, 3, 2))
ALONG_BACK, ACROSS_BACK = ((0, 2, 3), (0, 3, 1)), ((0, 2, 1), (1, 2, 3))
STRIPS = (
    ("upper_root", "upper_edge", ALONG, ACROSS),
    ("upper_root_back", "upper_edge_back", ALONG_BACK, ACROSS_BACK),
    ("upper_edge_back", "upper_edge", ACROSS_BACK, ALONG_BACK),
    ("lower_edge", "lower_root", ACROSS, ALONG),
    ("lower_root_back", "lower_edge_back", ALONG, ACROSS),
    ("lower_edge_back", "lower_edge", ACROSS, ALONG),
)
"""Two rows, and how quads are cut in the person's left half and in the right one."""


def with_teeth(flame: FlameModel) -> FlameModel:
    """FLAME with teeth as its last vertices and triangles. They follow the identity as the lips do, no
    expression, and no pose corrective.
    """
    rims = (flame.shapedirs[UPPER_RIM] + flame.shapedirs[LOWER_RIM]) / 2
    rims[:, :, N_FILE_IDENTITY:] = 0
    weights = np.zeros((len(ROWS), COLUMNS, flame.weights.shape[1]))
    for row, (jaw, _, _) in enumerate(ROWS.values()):
        weights[row, :, JAWS[jaw]] = 1
    return FlameModel(
        template=np.concatenate([flame.template, teeth_vertices(flame.template)]),
        faces=np.concatenate([flame.faces, teeth_faces() + len(flame.template)]).astype(np.int32),
        shapedirs=np.concatenate([flame.shapedirs, *[rims] * len(ROWS)]),
        posedirs=_grown(flame.posedirs),
        joint_regressor=_grown(flame.joint_regressor.T).T,
        weights=np.concatenate([flame.weights, weights.reshape(N_TEETH, -1)]),
    )


def teeth_vertices(template: np.ndarray) -> np.ndarray:
    """float64[120, 3] m behind the lips of a template [5023, 3]."""
    upper, lower = template[UPPER_RIM], template[LOWER_RIM]
    unit = np.linalg.norm(upper - lower, axis=1).mean()
    middle = (upper + lower) / 2
    middle[:, 1] = middle[:, 1].mean()
    return np.concatenate([middle + unit * np.array([0, up, -back]) for _, up, back in ROWS.values()])


def teeth_faces() -> np.ndarray:
    """int[168, 3]"""
    first = {name: row * COLUMNS for row, name in enumerate(ROWS)}
    faces = []
    for a, b, left, right in STRIPS:
        for column in range(COLUMNS - 1):
            corners = [first[row] + column + side for row in (a, b) for side in (0, 1)]
            cut = left if column < COLUMNS // 2 else right
            faces += [[corners[corner] for corner in triangle] for triangle in cut]
    return np.array(faces)


def _grown(array: np.ndarray) -> np.ndarray:
    """[5023, ...] -> [5143, ...] with zeros for the teeth."""
    return np.concatenate([array, np.zeros((N_TEETH, *array.shape[1:]))])
