"""What overlays mean: legends, colours, and the deformation behind them."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("onnx")

from dataclasses import replace
from types import SimpleNamespace

from cap4d.app.background import Backdrop, Checkerboard
from cap4d.app.layout import Rect
from cap4d.app.overlays.color_map import color_map
from cap4d.app.overlays.legend import Legend, rounded_up, ticks
from cap4d.app.overlays.overlays import Overlay, Overlays, Part, why_not
from cap4d.app.panels.legends import draw_legends
from cap4d.app.panels.overlays import draw_overlays
from cap4d.app.renderers import CpuRenderer, GlRenderer
from imgui_bundle import imgui
from tiny_bundle import tiny_bundle, tiny_bundle_on_mesh

from cap4d.player.avatar import Avatar


@pytest.mark.parametrize("name", ["viridis", "magma"])
def test_lighter_is_more(name: str) -> None:
    colors = color_map(name)
    assert colors.shape == (17, 3) and colors.dtype == np.uint8
    lightness = colors @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > 2).all() and lightness[0] < 30 and lightness[-1] > 210


def test_colours_are_those_of_matplotlib() -> None:
    matplotlib = pytest.importorskip("matplotlib")
    at = np.linspace(0, 1, 256)
    for name in ("viridis", "magma"):
        ours = np.stack([np.interp(at, np.linspace(0, 1, 17), c) for c in color_map(name).T / 255], -1)
        assert np.abs(ours - matplotlib.colormaps[name](at)[:, :3]).max() < 0.025


@pytest.mark.parametrize(
    ("value", "limit"),
    [
        (0.0, 1),
        (float("nan"), 1),
        (-3, 1),
        (0.011, 0.012),
        (1, 1),
        (1.3, 1.6),
        (30, 30),
        (81, 100),
        (2999, 3000),
    ],
)
def test_limits_are_round(value: float, limit: float) -> None:
    assert rounded_up(value) == pytest.approx(limit)


def test_the_last_tick_stands_for_what_is_beyond() -> None:
    assert ticks(2.0) == ((0.0, "0"), (0.25, "0.5"), (0.5, "1"), (0.75, "1.5"), (1.0, "2+"))


def test_deformation_is_what_the_network_moved() -> None:
    bundle = tiny_bundle(12)
    with_network, without = Avatar(bundle, deformer="full"), Avatar(bundle, deformer="off")
    for index in (0, 3, 7):
        frame = bundle.idle.frame(index)
        moved = with_network.move(frame) - (without.move(frame) - bundle.deform_neutral)
        np.testing.assert_allclose(with_network.deformation(), moved, atol=2e-7)
        np.testing.assert_array_equal(without.deformation(), bundle.deform_neutral)
    assert np.abs(with_network.deformation() - bundle.deform_neutral).max() > 1e-5


def test_deformation_is_what_stands_in_for_the_network() -> None:
    bundle = tiny_bundle(12, network=False)
    shape = (bundle.n_expressions, *bundle.subject.neutral.shape)
    linear = 1e-3 * np.random.default_rng(0).normal(size=shape).astype(np.float32)
    linear[:, ~bundle.grid.deformable] = 0
    bundle = replace(bundle, deform_linear=linear)
    expr = bundle.idle.frame(4).expr
    # at rest: what the joints turn turns with them
    still = replace(bundle, subject=replace(bundle.subject, expr_rotation=None))
    tiers = {tier: Avatar(still, deformer=tier) for tier in ("linear", "off")}
    vertices = {tier: avatar.vertices(expr) for tier, avatar in tiers.items()}
    moved = vertices["linear"] - vertices["off"] + bundle.deform_neutral
    np.testing.assert_allclose(tiers["linear"].deformation(), moved, atol=2e-7)
    assert np.abs(moved).max() > 1e-4


def test_asking_for_it_changes_nothing() -> None:
    avatar = Avatar(tiny_bundle(12))
    frame = avatar.idle.frame(2)
    before, deformation = avatar.move(frame).copy(), avatar.deformation().copy()
    avatar.deformation()[:] = 7
    np.testing.assert_array_equal(avatar.move(frame), before)
    np.testing.assert_array_equal(avatar.deformation(), deformation)


# With a context


@pytest.mark.parametrize("kind", [GlRenderer, CpuRenderer])
def test_the_window_may_have_any_size(kind, ctx) -> None:
    avatar = Avatar(tiny_bundle(network=False))
    renderer = kind(ctx, avatar) if kind is GlRenderer else kind(ctx, avatar, background=None)
    overlays, backdrop = Overlays(ctx, avatar), Backdrop(ctx)
    overlays.shown = set(Overlay)
    for size in ((1, 1), (3, 400), (200, 120), (1, 1), (1500, 40)):
        camera, target = avatar.camera.resized(*size), ctx.simple_framebuffer(size)
        picture = renderer.texture(avatar.idle.frame(1), camera)
        target.use()
        backdrop.draw(picture, Checkerboard(), upright=True)
        overlays.draw(renderer, camera, upright=True)
        ctx.gc()
        assert ctx.error == "GL_NO_ERROR" and len(target.read()) == 3 * size[0] * size[1]


def test_what_is_not_shown_is_not_made(ctx) -> None:
    avatar = Avatar(tiny_bundle(network=False))
    renderer, overlays = CpuRenderer(ctx, avatar), Overlays(ctx, avatar)
    renderer.texture(avatar.idle.frame(0), avatar.camera)
    overlays.draw(renderer, avatar.camera)
    assert vars(overlays)["_surface"] is vars(overlays)["_density"] is None and overlays.legends() == []


def test_limits_grow_and_legends_say_what_is_shown(ctx) -> None:
    avatar = Avatar(tiny_bundle(), deformer="full")
    renderer, overlays = CpuRenderer(ctx, avatar), Overlays(ctx, avatar)
    renderer.texture(avatar.idle.frame(3), avatar.camera)
    target = ctx.simple_framebuffer((32, 32))
    target.use()
    overlays.shown = {Overlay.DEFORMATION, Overlay.DENSITY}
    overlays.draw(renderer, avatar.camera.resized(32, 32))
    density, deformation = overlays.legends()
    assert (density.title, deformation.title) == ("Gaussians per pixel", "Deformation, mm")
    percentile = np.percentile(overlays.deformation_mm(), 98)
    assert percentile <= overlays.limits_mm[Part.ALL] <= 1.6 * percentile
    overlays.limits_mm[Part.ALL] = 1000.0
    overlays.draw(renderer, avatar.camera.resized(32, 32))
    assert overlays.legends()[1].ticks[-1] == (1.0, "1e+03+")
    overlays.part = Part.EXPRESSION
    assert overlays.legends()[1].title == "Deformation by expression, mm"
    assert (overlays.deformation_mm()[~avatar.bundle.grid.deformable] == 0).all()


def test_legends_are_drawn() -> None:
    context = imgui.create_context()
    try:
        io = imgui.get_io()
        io.set_ini_filename("")
        io.display_size = imgui.ImVec2(400, 300)
        io.backend_flags |= imgui.BackendFlags_.renderer_has_textures
        corners = []
        for legends in ([], [Legend("Gaussians per pixel", color_map("magma"), ticks(20.0))]):
            for _ in range(2):  # a panel that finds its size is hidden at first
                imgui.new_frame()
                draw_legends(legends, Rect(0, 0, 400, 300))
                imgui.render()
            corners.append(imgui.get_draw_data().total_vtx_count)
        assert corners[0] == 0 and corners[1] > 4 * 16 + 4 * len("Gaussiansperpixel")
    finally:
        for texture in imgui.get_platform_io().textures:
            texture.set_status(imgui.ImTextureStatus.destroyed)
        imgui.destroy_context(context)


# Without a grid ------------------------------------------------------------


def test_the_rigs_own_triangles_have_a_mesh_and_no_uv_grid(ctx) -> None:
    avatar = Avatar(tiny_bundle_on_mesh())
    reasons = {overlay: why_not(overlay, avatar.bundle) for overlay in Overlay}
    assert "no UV grid" in reasons[Overlay.UV] and "no network" in reasons[Overlay.DEFORMATION]
    assert reasons[Overlay.MESH] == reasons[Overlay.DENSITY] == ""
    assert not any(why_not(overlay, tiny_bundle(network=False)) for overlay in Overlay)
    renderer, overlays = CpuRenderer(ctx, avatar), Overlays(ctx, avatar)
    renderer.texture(avatar.idle.frame(1), avatar.camera)
    target, pictures = ctx.simple_framebuffer((48, 48)), []
    for shown in (set(), {Overlay.UV, Overlay.DEFORMATION}, {Overlay.MESH}, set(Overlay) - {Overlay.DENSITY}):
        target.use()
        target.clear()
        overlays.shown = shown
        overlays.draw(renderer, avatar.camera.resized(48, 48))
        pictures.append(target.read())
        assert overlays.legends() == []
    assert pictures[0] == pictures[1] != pictures[2] == pictures[3]
    assert ctx.error == "GL_NO_ERROR"


def test_the_panel_offers_what_the_avatar_has() -> None:
    context = imgui.create_context()
    try:
        io = imgui.get_io()
        io.set_ini_filename("")
        io.display_size = imgui.ImVec2(400, 300)
        io.backend_flags |= imgui.BackendFlags_.renderer_has_textures
        corners = []
        for bundle in (tiny_bundle(network=False), tiny_bundle_on_mesh()):
            viewer = SimpleNamespace(
                avatar=Avatar(bundle), overlays=frozenset(Overlay), overlay_part=Part.ALL
            )
            imgui.new_frame()
            draw_overlays(viewer)
            imgui.render()
            corners.append(imgui.get_draw_data().total_vtx_count)
            assert viewer.overlays == frozenset(Overlay)  # kept for the next avatar
        unwritten = 4 * len("Bytheexpression")  # corners of letters: there are no parts to choose
        assert corners[1] < corners[0] - 2 * unwritten
    finally:
        for texture in imgui.get_platform_io().textures:
            texture.set_status(imgui.ImTextureStatus.destroyed)
        imgui.destroy_context(context)
