"""Pictures of a made-up person: a rig's mesh with painted skin, lit by lights that are fixed to the head."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cap4d import _core
from cap4d.camera import Camera, opencv_from_rig
from cap4d.color import linear_from_srgb
from cap4d.mesh import rasterize_mesh, vertex_normals
from cap4d.rig.head import HeadRig, Subject
from cap4d.synth.atlas import KINDS, build_atlas, kinds_of_vertices
from cap4d.synth.complexion import Complexion, draw_complexion
from cap4d.synth.face_paint import paint_texture
from cap4d.synth.hair import Hair, HairLights, LitHair, composite_hair, draw_hair, grow_hair, light_hair
from cap4d.synth.idle import expression_vector, speaks_arkit
from cap4d.synth.light import Lights, Occlusion, cast_shadows, draw_lights

SUPERSAMPLE = 2  # samples per pixel side
IDENTITY_SPREAD, IDENTITY_LIMIT = 0.85, 2.0  # standard deviation and limit of each identity mode
HAIR_LIGHT, HAIR_SKY = 0.6, 1.3  # of the skin's linear light
SMOOTHINGS = 6  # rounds of averaging of the normals that scattered light sees
SHOULDER = 0.72  # linear value above which highlights are compressed


@dataclass(frozen=True, eq=False)
class Person:
    """Someone who does not exist: a rig's identity, their looks, and the light they stand in.

    Args:
        shape: float32[S] identity.
        subject: The rig with that identity.
        uvs: float32[T, 2] texture vertices in texels; `texture`: float32[S, S, 8], see `paint_texture`.
        neighbours: Sparse matrix that averages each vertex with those around it.
    """

    rig: HeadRig
    shape: np.ndarray
    subject: Subject
    look: Complexion
    lights: Lights
    hair: Hair
    occlusion: Occlusion
    uvs: np.ndarray
    texture: np.ndarray
    neighbours: Any


@dataclass(frozen=True, eq=False)
class Samples:
    """An image before its samples are averaged: `rgb` float32[H, W, 3] linear, multiplied by `alpha`
    float32[H, W]; `depth` float32[H, W] m along the camera's axis, infinite where nothing is.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


@dataclass(frozen=True, eq=False)
class Pose:
    """The person in one frame, head-fixed, OpenCV axes: vertices, their normals and smoothed normals [V, 3],
    and the hair in its light.
    """

    vertices: np.ndarray
    normals: np.ndarray
    soft: np.ndarray
    hair: LitHair


def draw_person(rig: HeadRig, identity: int, *, texels: int = 1024) -> Person:
    """The person with this number: the same on any machine, for any size of texture."""
    atlas = build_atlas(rig, texels)
    body, looks, light = (np.random.default_rng([identity, part]) for part in range(3))
    shape = np.clip(body.normal(0, IDENTITY_SPREAD, rig.n_identity), -IDENTITY_LIMIT, IDENTITY_LIMIT)
    shape = shape.astype(np.float32)
    subject, lights = rig.subject(shape), draw_lights(light)
    hair = grow_hair(rig, subject.neutral, seed=identity)
    look = draw_complexion(looks, linear_from_srgb(np.asarray(hair.color, np.float64)))
    return Person(
        rig=rig,
        shape=shape,
        subject=subject,
        look=look,
        lights=lights,
        hair=hair,
        occlusion=_occlusion(rig, subject, lights).dimmed(1 - hair.shadow),
        uvs=atlas.uvs,
        texture=paint_texture(rig, atlas, look, hair.scalp),
        neighbours=_neighbours(rig.faces, len(rig.template)),
    )


def pose_person(person: Person, vertices: np.ndarray) -> Pose:
    """What all pictures of one frame share. `vertices` [V, 3] head-fixed, OpenCV axes."""
    faces = person.rig.faces
    normals = vertex_normals(vertices, faces)
    hair = light_hair(person.hair, person.hair.pose(vertices), _hair_lights(person.lights))
    return Pose(vertices, normals, _smoothed(normals, person.neighbours), hair)


def draw_samples(person: Person, pose: Pose, camera: Camera) -> Samples:
    """The head alone, at the camera's own resolution.

    Args:
        camera: In the head-fixed world (see `head_fixed`).
    """
    fragments = rasterize_mesh(pose.vertices, person.rig.faces, camera)
    depths = pose.vertices @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    lights = person.lights
    rgb, depth = _core.light_surface(
        fragments.face,
        fragments.bary,
        np.ascontiguousarray(person.rig.faces, np.int32),
        np.ascontiguousarray(person.rig.uv_faces, np.int32),
        *(np.ascontiguousarray(a, np.float32) for a in (pose.vertices, pose.normals, pose.soft, depths)),
        person.occlusion.open,
        person.occlusion.visible,
        person.uvs,
        person.texture,
        lights.directions,
        lights.colors,
        lights.sky,
        lights.ground,
        np.array([0, -1, 0], np.float32),
        camera.position.astype(np.float32),
    )
    return Samples(rgb, fragments.hit.astype(np.float32), depth)


def picture(person: Person, pose: Pose, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Straight sRGB [H, W, 3] and coverage [H, W] of a posed person; `camera` is head-fixed."""
    large = camera.resized(camera.width * SUPERSAMPLE, camera.height * SUPERSAMPLE)
    samples = draw_samples(person, pose, large)
    rgb, matte = develop(samples, SUPERSAMPLE)
    layer = draw_hair(pose.hair, camera, samples.depth)
    return composite_hair(rgb, matte, layer)


def develop(samples: Samples, supersample: int) -> tuple[np.ndarray, np.ndarray]:
    """Straight sRGB [H, W, 3] (white where nothing is) and coverage [H, W]."""
    height, width = (n // supersample for n in samples.alpha.shape)
    boxes = (height, supersample, width, supersample)
    matte = samples.alpha.reshape(boxes).mean((1, 3))
    linear = samples.rgb.reshape(*boxes, 3).mean((1, 3)) / np.maximum(matte, 1e-6)[..., None]
    return np.where(matte[..., None] > 0, srgb(linear), 1), matte


def srgb(linear: np.ndarray) -> np.ndarray:
    """Linear light to sRGB in [0, 1], highlights rolled off."""
    over = np.maximum(linear - SHOULDER, 0)
    linear = np.minimum(linear, SHOULDER) + (1 - SHOULDER) * (1 - np.exp(-over / (1 - SHOULDER)))
    low = linear * 12.92
    return np.where(linear < 0.0031308, low, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def _hair_lights(lights: Lights) -> HairLights:
    """Hair is lit in display values: strengths that look as the skin's do."""
    return HairLights(
        directions=lights.directions,
        strengths=HAIR_LIGHT * lights.colors.mean(1),
        sky=HAIR_SKY * float(lights.sky.mean()),
        ground=HAIR_SKY * float(lights.ground.mean()),
        up=np.array([0.0, -1.0, 0.0]),
    )


def _occlusion(rig: HeadRig, subject: Subject, lights: Lights) -> Occlusion:
    """At rest; inside the mouth as seen when it is open, and the skin half of each."""
    rest = cast_shadows(_head(subject, np.zeros(rig.n_expressions, np.float32)), rig.faces, lights)
    if not speaks_arkit(rig):
        return rest
    jaw = expression_vector(rig, {"jawOpen": 0.6, "mouthUpperUp": 0.3, "mouthLowerDown": 0.3})
    talking = cast_shadows(_head(subject, jaw), rig.faces, lights)
    inside = np.isin(kinds_of_vertices(rig), [KINDS.index(k) for k in ("teeth", "gums", "cavity")])
    return rest.mixed(talking, np.where(inside, 1.0, 0.5))


def _head(subject: Subject, expr: np.ndarray) -> np.ndarray:
    return opencv_from_rig(subject.pose(expr).astype(np.float64))


def _neighbours(faces: np.ndarray, count: int):
    """Sparse [count, count] matrix that averages every vertex with those around it."""
    from scipy.sparse import csr_matrix, diags, identity

    rows, columns = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    ends = (np.concatenate([rows, columns]), np.concatenate([columns, rows]))
    links = csr_matrix((np.ones(2 * len(rows), np.float32), ends), (count, count)) + identity(
        count, np.float32
    )
    return (diags(1 / np.asarray(links.sum(1)).ravel()) @ links).astype(np.float32).tocsr()


def _smoothed(normals: np.ndarray, neighbours) -> np.ndarray:
    """[V, 3] normals averaged over their neighbourhood: what light sees that wanders under the skin."""
    soft = normals.astype(np.float32)
    for _ in range(SMOOTHINGS):
        soft = neighbours @ soft
    return soft / np.maximum(np.linalg.norm(soft, axis=1, keepdims=True), 1e-12)
