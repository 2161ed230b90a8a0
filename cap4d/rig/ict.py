"""ICT-FaceKit Light (Li et al. 2020) as a HeadRig: metres, joints, one atlas, shoulders, colours.

Vertices 0 to 24590 keep ICT's numbering; lacrimal fluid, eye blend, occlusion shells and eyelashes after them
are left out and the shoulders take their place. The inner iris layers and the backs of the eyeballs keep
their vertices but have no faces. Expression names are the files' own: ARKit's with _L and _R. The origin is
where FLAME has it, judged by the
eyes: they lie 23 mm above it and 6 mm in front.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cap4d.rig import paint
from cap4d.rig.atlas import add_skirts, enlarge_busy, islands, place, unmirror, weld
from cap4d.rig.bust import grow_bust, open_edge
from cap4d.rig.head import HeadRig
from cap4d.rig.ict_source import IctModel, read_ict
from cap4d.rig.ict_teeth import front_strip
from cap4d.rig.obj import triangulate

NAME = "ict_facekit_light"
LICENCE = "MIT"  # of ICT-FaceKit Light; the file beside the model holds its notice
ORIGIN_CM = np.array([0.0, 1.27, 7.29])  # the rig's origin in the model's coordinates
N_KEPT = 24591  # vertices before the lacrimal fluid

# Vertex ranges of the model (its README); `eye_*` are the outer layers, which carry the iris as paint.
RANGES = {
    "face": (0, 9409),
    "head_and_neck": (9409, 11248),
    "mouth_socket": (11248, 13294),
    "eye_sockets": (13294, 14062),
    "gums": (14062, 17039),
    "teeth": (17039, 21451),
    "eye_left": (21451, 22221),
    "eye_right": (23021, 23791),
}

# The 68 Multi-PIE landmarks as vertices (the model's `idx_to_landmark_verts`).
# fmt: off
LANDMARKS = np.array([
    1225, 1888, 1052, 367, 1719, 1722, 2199, 1447, 966, 3661, 4390, 3927, 3924, 2608, 3272, 4088, 3443,
    268, 493, 1914, 2044, 1401, 3615, 4240, 4114, 2734, 2509, 978, 4527, 4942, 4857, 1140, 2075, 1147,
    4269, 3360, 1507, 1542, 1537, 1528, 1518, 1511, 3742, 3751, 3756, 3721, 3725, 3732, 5708, 5695,
    2081, 0, 4275, 6200, 6213, 6346, 6461, 5518, 5957, 5841, 5702, 5711, 5533, 6216, 6207, 6470, 5517,
    5966,
], np.int32)
# fmt: on

# Where each tile lies in the atlas, in pixels of a 128 grid: u0, v0, u1, v1. Most of it is face.
BOXES = {
    "face": (0, 48, 88, 128),
    "head_and_neck": (0, 0, 88, 48),
    "bust": (88.495, 0.495, 127.6, 61.505),  # its ends, which meet at the back, lie on pixel centres
    "eye_left": (88, 108, 108, 128),
    "eye_right": (108, 108, 128, 128),
    "teeth_upper": (88, 97.5, 128, 108),
    "teeth_lower": (88, 87, 128, 96.5),
    "gums": (88, 62, 114, 87),
    "mouth_socket": (114, 69, 128, 87),
    "eye_socket_left": (114, 62, 121, 69),
    "eye_socket_right": (121, 62, 128, 69),
}
EYE_R, EYE_L = slice(36, 42), slice(42, 48)  # in LANDMARKS
SKIRT = 0.65 / 128  # of the atlas
LID_WEIGHT = 4.0  # of a vertex at the lids, beside one elsewhere
FACE_WARP = 0.5  # share of the face tile's room given out by vertex density

SKULL_BASE_CM = np.array(
    [0.0, -2.0, -1.5]
)  # where the neck turns: the atlas joint, below and between the ears
NAPE_CM, CHIN_CM = (
    np.array([-4.0, -8.0]),
    np.array([-11.5, 5.0]),
)  # y, z of the line above which the neck is rigid
NECK_BLEND = 0.055  # m over which the neck takes over below that line


def import_ict(path: Path) -> HeadRig:
    """Makes a rig of a FaceXModel folder or of the packed .npz.

    Raises:
        DataError: One line that names the file, the field, what was expected and what was found.
    """
    model = read_ict(path)
    points = (model.neutral[:N_KEPT].astype(np.float64) - ORIGIN_CM) / 100
    identity = model.identity[:, :N_KEPT] / 100
    expression = model.expression[:, :N_KEPT] / 100
    expression[:, RANGES["eye_left"][0] : N_KEPT] = (
        0  # the joints alone turn the balls, eyeLook* only moves the lids
    )
    faces, uvs, uv_faces, uv_tiles = _mesh(model, points)

    skin = faces[(faces < RANGES["eye_sockets"][1]).all(1)]
    edge = open_edge(skin)
    edge = np.roll(edge, -int(np.argmin(points[edge, 2])))
    bust = grow_bust(points[edge], _leaving(points, skin, edge))
    bust_ids = np.concatenate([edge, N_KEPT + np.arange(len(bust.vertices))]).astype(np.int32)
    faces = np.concatenate([faces, bust_ids[bust.faces]])
    uv_faces = np.concatenate([uv_faces, bust.uv_faces + len(uvs)])
    uvs = np.concatenate([uvs, place(bust.uvs, _box("bust"), gutter=0)])
    outside = (uv_tiles == "face") | (uv_tiles == "head_and_neck")
    outside = np.append(outside[uv_faces[: -len(bust.faces), 0]], np.ones(len(bust.faces), bool))
    uvs, uv_faces, faces = add_skirts(uvs, uv_faces, faces, where=outside, width=SKIRT)

    weights, regressors = _joints(points)
    template = np.concatenate([points, bust.vertices])
    identity = np.concatenate([identity, bust.continue_offsets(identity[:, edge])], 1)
    expression = np.concatenate([expression, bust.continue_offsets(expression[:, edge])], 1)
    weights = np.concatenate([weights, np.tile([1.0, 0, 0], (len(bust.vertices), 1))])
    regressors = np.concatenate([regressors, np.zeros((3, len(bust.vertices)))], 1)
    return HeadRig(
        name=NAME,
        licence=LICENCE,
        template=template.astype(np.float32),
        faces=faces,
        uvs=uvs.astype(np.float32),
        uv_faces=uv_faces,
        identity_basis=identity.astype(np.float32),
        expression_basis=expression.astype(np.float32),
        expression_names=model.expression_names,
        expression_range=np.tile(np.float32([0, 1]), (len(expression), 1)),
        joint_names=("neck", "eye_left", "eye_right"),
        joint_drivers=("neck", "eyes", "eyes"),
        joints=(regressors @ template).astype(np.float32),
        joints_identity=(regressors @ identity).astype(np.float32),
        joints_expression=(regressors @ expression).astype(np.float32),
        skin_weights=weights.astype(np.float32),
        colors=_colors(template).astype(np.float32),
        regions=_regions(template, weights[:, 0]),
    )


def _box(tile: str) -> tuple[float, float, float, float]:
    return tuple(edge / 128 for edge in BOXES[tile])


def _in_range(ids: np.ndarray, part: str) -> np.ndarray:
    return (ids >= RANGES[part][0]) & (ids < RANGES[part][1])


def _mesh(model: IctModel, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Triangles of the parts that are kept, their texture in the atlas, and text[T] the tile of each texture
    vertex.
    """
    faces, uv_faces = triangulate(model.faces, model.uv_faces)
    all_faces = faces
    parts = _part_of_faces(faces, model.uvs[uv_faces].mean(1))
    kept = parts >= 0
    faces, parts = faces[kept], parts[kept]
    uvs, uv_faces = weld(model.uvs, uv_faces[kept], faces)
    uvs = unmirror(uvs, uv_faces)
    vertex = np.zeros(len(uvs), int)
    vertex[uv_faces] = faces
    tiles = _tile_of_uvs(uvs, uv_faces, parts, points[vertex, 0])
    for tile in np.unique(tiles):
        ids = tiles == tile
        if tile == "face":
            uvs[ids] = enlarge_busy(uvs[ids], _importance(points[vertex[ids]], points), strength=FACE_WARP)
        uvs[ids] = place(uvs[ids], _box(tile))
    for row in ("teeth_upper", "teeth_lower"):
        strip = front_strip(points, _of(all_faces, row), _of(all_faces, "gums"), upper=row == "teeth_upper")
        faces = np.concatenate([faces, strip[0]])
        uv_faces = np.concatenate([uv_faces, strip[2] + len(uvs)])
        uvs = np.concatenate([uvs, place(strip[1], _box(row))])
        tiles = np.concatenate([tiles, np.full(len(strip[1]), row, tiles.dtype)])
    return faces, uvs, uv_faces, tiles


def _of(faces: np.ndarray, part: str) -> np.ndarray:
    start, end = {**RANGES, "teeth_upper": (17039, 19247), "teeth_lower": (19247, 21451)}[part]
    return faces[(faces[:, 0] >= start) & (faces[:, 0] < end)]


def _part_of_faces(faces: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """int[F] index into RANGES, -1 for faces that are left out. `centres` [F, 2] are in the model's UVs."""
    parts = np.full(len(faces), -1)
    for index, part in enumerate(RANGES):
        if part != "teeth":  # they get texture of their own
            parts[_in_range(faces[:, 0], part)] = index
        if part.startswith("eye_") and part != "eye_sockets":
            back = np.hypot(*(centres - 0.5).T) > 0.5  # the front is a disc in the middle of the tile
            parts[(parts == index) & back] = -1
    return parts


def _tile_of_uvs(uvs: np.ndarray, uv_faces: np.ndarray, parts: np.ndarray, x: np.ndarray) -> np.ndarray:
    """text[T] the tile of each texture vertex: the part that most faces of its island belong to; sockets by
    side.
    """
    label = islands(uv_faces, len(uvs))
    votes = np.zeros((len(uvs), len(RANGES)))
    np.add.at(votes, (label[uv_faces[:, 0]], parts), 1)
    votes[(uvs[:, 0] > 1), 0] = 0  # ears lie half in the second tile
    tiles = np.array(list(RANGES), "U20")[votes.argmax(1)][label]
    sockets = tiles == "eye_sockets"
    tiles[sockets] = np.where(x[sockets] > 0, "eye_socket_left", "eye_socket_right")
    return tiles


def _importance(vertices: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[T] how much room the surroundings of a face vertex deserve: lids most of all."""
    lids = np.minimum(
        *(paint.distance_to_line(vertices, points[LANDMARKS[eye]], closed=True) for eye in (EYE_R, EYE_L))
    )
    return 1 + LID_WEIGHT * np.exp(-((lids / 0.008) ** 2))


def _leaving(points: np.ndarray, faces: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """[L, 3] direction in which the skin reaches each vertex of its open edge, smoothed along it."""
    on_edge = np.isin(faces, edge)
    inner = np.zeros((len(points), 3))
    count = np.zeros(len(points))
    for face, mask in zip(faces[on_edge.any(1)], on_edge[on_edge.any(1)], strict=True):
        for vertex in face[mask]:
            inner[vertex] += points[face[~mask]].sum(0)
            count[vertex] += (~mask).sum()
    direction = points[edge] - inner[edge] / count[edge, None]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    for _ in range(3):
        direction = (np.roll(direction, 1, 0) + 2 * direction + np.roll(direction, -1, 0)) / 4
    return direction


def _joints(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[V, 3] skin weights and [3, V] regressors of the joints neck, left eye, right eye."""
    weights = np.zeros((len(points), 3))
    regressors = np.zeros((3, len(points)))
    y, z = (points[:, 1:] * 100 + ORIGIN_CM[1:]).T
    along = CHIN_CM - NAPE_CM
    down = np.array([-along[1], along[0]]) / np.hypot(*along)
    below = ((y - NAPE_CM[0]) * down[0] + (z - NAPE_CM[1]) * down[1]) / 100
    weights[:, 0] = paint.soft_step(below, 0, NECK_BLEND)
    weights[RANGES["eye_sockets"][0] :, 0] = 0
    weights[slice(*RANGES["mouth_socket"]), 0] = 0
    skull = (SKULL_BASE_CM - ORIGIN_CM) / 100
    start, end = RANGES["head_and_neck"]
    regressors[0, start:end] = _affine_regressor(points[start:end], skull)
    for joint, part in ((1, "eye_left"), (2, "eye_right")):
        start, end = RANGES[part]
        regressors[joint, start:end] = _affine_regressor(points[start:end], _ball_centre(points[start:end]))
        weights[start : start + (N_KEPT - RANGES["eye_right"][0]), joint] = 1  # with the inner layer
    return weights, regressors


def _ball_centre(points: np.ndarray) -> np.ndarray:
    """[3] least-squares centre of an eyeball, its bulging cornea (the front third) left out."""
    ball = points[points[:, 2] < np.quantile(points[:, 2], 0.6)]
    system = np.column_stack([2 * ball, np.ones(len(ball))])
    return np.linalg.lstsq(system, (ball * ball).sum(1), rcond=None)[0][:3]


def _affine_regressor(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[V] smallest weights that sum to 1 and mix `points` to `target`: it follows any affine motion of the
    points.
    """
    system = np.column_stack([points, np.ones(len(points))])
    return np.linalg.pinv(system).T @ np.append(target, 1.0)


def _colors(points: np.ndarray) -> np.ndarray:
    colors = np.tile(np.array(paint.SKIN), (len(points), 1))
    skin = slice(0, RANGES["head_and_neck"][1])
    colors[skin] = paint.paint_face(points[skin], points[LANDMARKS])
    colors[slice(*RANGES["mouth_socket"])] = paint.CAVITY
    colors[slice(*RANGES["gums"])] = paint.GUMS
    colors[slice(*RANGES["teeth"])] = paint.TEETH
    for part in ("eye_left", "eye_right"):
        ball = points[slice(*RANGES[part])]
        colors[slice(*RANGES[part])] = paint.paint_eye(ball, _ball_centre(ball))
    colors[N_KEPT:] = paint.SHIRT
    return colors


def _regions(points: np.ndarray, neck_weight: np.ndarray) -> dict[str, np.ndarray]:
    ids = np.arange(len(points), dtype=np.int32)
    part = {name: ids[start:end] for name, (start, end) in RANGES.items()}
    upper = ids[(neck_weight < 0.5) & (ids < N_KEPT)]
    back = part["head_and_neck"]
    return {
        "head": upper,
        "deformable": np.setdiff1d(
            upper, back
        ),  # like CAP4D's: all but the back of the head and the lower neck
        "face": np.intersect1d(part["face"], upper),
        "scalp": back[(points[back, 1] > 0) & (neck_weight[back] == 0)],
        "eyes": np.concatenate([part["eye_left"], part["eye_right"]]),
        "eye_left": part["eye_left"],
        "eye_right": part["eye_right"],
        "teeth": part["teeth"],
        "mouth": np.concatenate([part["mouth_socket"], part["gums"]]),
        "bust": ids[N_KEPT:],
        "landmarks": LANDMARKS,
    }
