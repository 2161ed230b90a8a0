"""Hair of synthetic heads: where it grows, how it follows a head, and what of it is seen."""

from __future__ import annotations

import numpy as np
import pytest

from cap4d import _core
from cap4d.camera import opencv_from_rig, orbit_camera
from cap4d.errors import ArgumentError
from cap4d.mesh import rasterize_mesh
from cap4d.rig.head import HeadRig
from cap4d.rotation import axis_angle_to_rotmat
from cap4d.synth.hair import Hair, HairLayer, HairLights, composite_hair, draw_hair, grow_hair, light_hair
from cap4d.synth.hair.face import LASHES
from cap4d.synth.hair.style import STYLES, WEIGHTS

RADII = np.array([0.078, 0.115, 0.1])  # m, of a head that is an ellipsoid
CENTRE = np.array([0.0, 0.0, -0.05])
LIGHTS = HairLights(np.array([[-0.4, -0.8, -1.0]]), np.array([0.4]), 0.6, 0.4, np.array([0.0, -1.0, 0.0]))


def egg_rig() -> HeadRig:
    """An ellipsoid with one expression that lifts its front, and no names for its parts."""
    rows, columns = 36, 48
    polar, turn = np.meshgrid(np.linspace(0.02, np.pi - 0.02, rows), np.arange(columns) / columns * 2 * np.pi)
    unit = np.stack([np.sin(polar) * np.sin(turn), np.cos(polar), np.sin(polar) * np.cos(turn)], -1)
    points = (unit.reshape(-1, 3) * RADII + CENTRE).astype(np.float32)
    index = np.arange(rows * columns).reshape(columns, rows)
    a, b = index[:, :-1].ravel(), index[:, 1:].ravel()
    c, d = np.roll(index, -1, 0)[:, 1:].ravel(), np.roll(index, -1, 0)[:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    lift = np.where(points[:, 2:] > 0, 0.004, 0) * np.float32([0, 1, 0])
    none = np.zeros((0, 3), np.float32)
    return HeadRig(
        name="egg",
        licence="none",
        template=points,
        faces=faces,
        uvs=points[:, :2] * 0,
        uv_faces=faces,
        identity_basis=np.zeros((0, len(points), 3), np.float32),
        expression_basis=lift[None].astype(np.float32),
        expression_names=("lift",),
        expression_range=np.float32([[0, 1]]),
        joint_names=(),
        joint_drivers=(),
        joints=none,
        joints_identity=np.zeros((0, 0, 3), np.float32),
        joints_expression=np.zeros((1, 0, 3), np.float32),
        skin_weights=np.zeros((len(points), 0), np.float32),
        regions={name: np.arange(len(points), dtype=np.int32) for name in ("head", "deformable")},
    )


@pytest.fixture(scope="module")
def egg() -> HeadRig:
    return egg_rig()


@pytest.fixture(scope="module")
def hair(egg: HeadRig) -> Hair:
    return grow_hair(egg, egg.template, seed=3, style="side-part", density=0.1)


def level(points: np.ndarray) -> np.ndarray:
    """1 on the ellipsoid, less inside."""
    return np.linalg.norm((points - CENTRE) / RADII, axis=-1)


def camera(yaw_deg: float = 0, size: int = 64):
    target = opencv_from_rig(CENTRE)
    return orbit_camera(
        yaw_deg=yaw_deg, pitch_deg=0, distance=1, target=target, fov_y_deg=18, width=size, height=size
    )


def depth_of(rig: HeadRig, vertices: np.ndarray, view) -> np.ndarray:
    return rasterize_mesh(vertices, rig.faces, view).interpolate(view.project(vertices)[:, 2:], rig.faces)[
        ..., 0
    ]


def test_the_same_seed_grows_the_same_hair_and_another_seed_other_hair(egg: HeadRig, hair: Hair) -> None:
    again = grow_hair(egg, egg.template, seed=3, style="side-part", density=0.1)
    assert again.strands.tobytes() == hair.strands.tobytes()
    assert again.colors.tobytes() == hair.colors.tobytes()
    other = grow_hair(egg, egg.template, seed=4, style="side-part", density=0.1)
    assert not np.array_equal(other.strands, hair.strands)


@pytest.mark.parametrize("style", sorted(STYLES))
def test_every_style_grows_outside_the_head_from_roots_on_it(egg: HeadRig, style: str) -> None:
    hair = grow_hair(egg, egg.template, seed=1, style=style, density=0.03)
    assert np.isfinite(hair.strands).all() and np.isfinite(hair.through).all()
    assert hair.style == style
    head = hair.strands[~hair.skin]
    assert len(head) == round(0.03 * STYLES[style].count)
    inside = 1 - level(hair.strands)
    ears = np.abs(hair.strands[..., 0]) > 0.75 * RADII[0]  # where ears would be, a flat plug is the skin
    assert inside[~ears].max(initial=0) < 0.015  # the mesh's triangles lie a little inside the ellipsoid
    assert inside[ears].max(initial=0) < 0.04
    np.testing.assert_allclose(hair.roots.on(egg.template.astype(np.float64)), hair.strands[:, 0], atol=3e-4)
    assert (head[:, 0, 1] > CENTRE[1] - 0.6 * RADII[1]).all(), "hair grows on the chin"
    in_face = (head[:, 0, 2] > 0) & (head[:, 0, 1] < 0.03) & (np.abs(head[:, 0, 0]) < 0.04)
    assert not in_face.any()


def test_styles_are_drawn_by_lot() -> None:
    assert set(WEIGHTS) == set(STYLES) and abs(sum(WEIGHTS.values()) - 1) < 1e-9


def test_an_unknown_style_is_refused(egg: HeadRig) -> None:
    with pytest.raises(ArgumentError, match="style: expected"):
        grow_hair(egg, egg.template, seed=0, style="mohawk")


def test_hair_follows_a_moved_head_rigidly(egg: HeadRig, hair: Hair) -> None:
    rotmat, shift = axis_angle_to_rotmat(np.array([0.3, -0.7, 0.2])), np.array([0.1, -0.2, 0.4])
    moved = hair.pose(egg.template @ rotmat.T + shift)
    np.testing.assert_allclose(moved, hair.strands @ rotmat.T + shift, atol=1e-6)
    assert np.abs(hair.pose(egg.template) - hair.strands).max() < 1e-6


def test_an_expression_moves_the_brows_but_not_the_hair_behind(egg: HeadRig, hair: Hair) -> None:
    moved = hair.pose(egg.template + egg.expression_basis[0]) - hair.strands
    brows = hair.skin & (hair.strands[:, 0, 2] > 0.005)
    assert brows.sum() > 100
    np.testing.assert_allclose(moved[brows, :, 1], 0.004, atol=0.0015)
    behind = ~hair.skin & (hair.strands[:, :, 2].max(1) < -0.08)
    assert behind.sum() > 100 and np.abs(moved[behind]).max() < 2e-4


def test_a_wrong_number_of_vertices_is_refused(egg: HeadRig, hair: Hair) -> None:
    with pytest.raises(ArgumentError, match="vertices: expected"):
        hair.pose(egg.template[:-1])


def test_degenerate_triangles_give_finite_strands(egg: HeadRig, hair: Hair) -> None:
    flat = egg.template.astype(np.float64)
    flat[egg.faces[::3, 1]] = flat[egg.faces[::3, 0]]
    assert np.isfinite(hair.pose(flat)).all()
    assert np.isfinite(hair.pose(np.zeros_like(flat))).all()
    grown = grow_hair(egg, flat, seed=0, style="crop", density=0.02)
    assert np.isfinite(grown.strands).all() and np.isfinite(grown.shadow).all()


def test_the_bald_have_no_hair_but_brows(egg: HeadRig) -> None:
    hair = grow_hair(egg, egg.template, seed=2, style="bald")
    assert hair.skin.all() and len(hair) > 100
    assert not hair.scalp.any() and not hair.shadow.any()
    vertices = opencv_from_rig(egg.template.astype(np.float64))
    view = camera(180)
    layer = draw_hair(light_hair(hair, hair.pose(vertices), LIGHTS), view, depth_of(egg, vertices, view))
    assert not layer.alpha.any()


def test_hair_behind_the_head_is_hidden(egg: HeadRig, hair: Hair) -> None:
    vertices = opencv_from_rig(egg.template.astype(np.float64))
    points, view = hair.pose(vertices), camera(0, 128)
    depth = depth_of(egg, vertices, view)
    free = draw_hair(light_hair(hair, points, LIGHTS), view)
    seen = draw_hair(light_hair(hair, points, LIGHTS), view, depth)
    rows = [round(view.project(opencv_from_rig(CENTRE + [0, y, 0]))[1]) for y in (0.01, -0.03)]
    face = np.zeros((128, 128), bool)
    face[rows[0] : rows[1], 50:78] = True  # shows the nape's hair, if the head does not hide it
    assert free.alpha[face].max() > 0.2 and seen.alpha[face].max() == 0
    assert seen.alpha[:40].max() > 0.5
    wall = draw_hair(light_hair(hair, points, LIGHTS), view, np.full((128, 128), 0.5))
    assert not wall.alpha.any() and not wall.rgb.any()


def test_the_picture_does_not_depend_on_the_frame_of_the_world(egg: HeadRig, hair: Hair) -> None:
    vertices = opencv_from_rig(egg.template.astype(np.float64))
    view = camera(30)
    one = draw_hair(light_hair(hair, hair.pose(vertices), LIGHTS), view)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axis_angle_to_rotmat(np.array([0.2, 0.5, -0.1])), [0.3, 0.1, -0.2]
    turn = pose[:3, :3]
    lights = HairLights(LIGHTS.directions @ turn.T, LIGHTS.strengths, 0.6, 0.4, turn @ LIGHTS.up)
    moved = type(view)(view.K, view.viewmat @ np.linalg.inv(pose), view.width, view.height)
    other = draw_hair(light_hair(hair, hair.pose(vertices @ turn.T + pose[:3, 3]), lights), moved)
    assert np.abs(one.rgb - other.rgb).mean() < 1e-3 and np.abs(one.alpha - other.alpha).mean() < 1e-3


def test_depth_of_any_whole_multiple_is_taken_and_others_are_refused(egg: HeadRig, hair: Hair) -> None:
    points = hair.pose(opencv_from_rig(egg.template.astype(np.float64)))
    for n in (1, 2, 3):
        layer = draw_hair(light_hair(hair, points, LIGHTS), camera(), np.zeros((64 * n, 64 * n)))
        assert layer.rgb.shape == (64, 64, 3) and 0.3 < layer.alpha.max() <= 1
        assert (layer.rgb <= layer.alpha[..., None] + 1e-6).all()
    with pytest.raises(ArgumentError, match="depth: expected a whole multiple"):
        draw_hair(light_hair(hair, points, LIGHTS), camera(), np.zeros((100, 64)))


def test_hair_behind_the_camera_is_not_drawn(egg: HeadRig, hair: Hair) -> None:
    points = hair.pose(opencv_from_rig(egg.template.astype(np.float64))) - np.float32([0, 0, 5])
    assert not draw_hair(light_hair(hair, points, LIGHTS), camera()).alpha.any()


def test_compositing_keeps_what_is_bare_and_fills_mattes() -> None:
    alpha = np.float32([[0, 0.5, 1]])
    layer = HairLayer(alpha[..., None] * np.float32([0.2, 0.1, 0.0]), alpha)
    rgb, matte = composite_hair(np.full((1, 3, 3), 0.8), np.array([[1.0, 0.0, 0.4]]), layer)
    np.testing.assert_allclose(matte, [[1, 0.5, 1]], atol=1e-6)
    np.testing.assert_allclose(rgb[0], [[0.8] * 3, [0.2, 0.1, 0], [0.2, 0.1, 0]], atol=1e-6)


def test_hair_grows_and_casts_shadow_on_the_scalp_and_not_the_face(egg: HeadRig, hair: Hair) -> None:
    top, nose = np.argmax(egg.template[:, 1]), np.argmax(egg.template[:, 2])
    assert hair.scalp[nose] == 0 < hair.scalp[top]
    assert hair.shadow[nose] < hair.shadow[top] <= 0.7


def test_grows_on_the_builtin_rig(builtin_rig: HeadRig) -> None:
    hair = grow_hair(builtin_rig, builtin_rig.template, seed=0, style="crop", density=0.02)
    modelled = set(builtin_rig.regions["hair"].tolist())
    assert set(hair.roots.corners[~hair.skin].ravel().tolist()) <= modelled
    lashes = hair.strands[-2 * LASHES :, 0]
    assert (np.abs(lashes[:, 1] - 0.02) < 0.02).all(), "lashes are not at the eyes"


def test_a_line_covers_its_width_and_never_twice() -> None:
    line = np.float32([[[4, 8.0, 1], [16, 8, 1], [28, 8, 1]]])
    rgba, width = np.ones((1, 3, 4), np.float32), np.full((1, 3), 2, np.float32)
    rgba[..., 3] = 0.5
    far = np.full((16, 32), np.inf, np.float32)
    rgb, clear = _core.draw_strands(line, rgba, width, far, 0.01)
    np.testing.assert_allclose(1 - clear[6:10, 4:28], np.float32([[0], [0.5], [0.5], [0]]) + np.zeros(24))
    assert clear.sum() == 16 * 32 - 24 * 2 * 0.5
    np.testing.assert_allclose(rgb[..., 0], 1 - clear, atol=1e-6)
    _, thin = _core.draw_strands(line, rgba, width / 8, far, 0.01)
    np.testing.assert_allclose((1 - thin).sum(), 24 * 0.25 * 0.5, atol=1e-4)


def test_lines_that_are_not_finite_are_skipped() -> None:
    lines = np.full((4, 2, 3), 5, np.float32)
    lines[:, 1, 0] = 12
    for k, poison in enumerate((np.nan, np.inf, 1e9)):
        lines[k, 1] = poison
    rgba, width = np.ones((4, 2, 4), np.float32), np.ones((4, 2), np.float32)
    rgb, clear = _core.draw_strands(lines, rgba, width, np.full((9, 16), np.inf, np.float32), 0.01)
    assert np.isfinite(rgb).all() and 0 < (1 - clear).sum() < 8
