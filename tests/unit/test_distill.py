"""Lines in place of the network: what is linear is recovered, joints turned or not; what is not, nearly."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from test_export import trained_looking
from tiny_bundle import tiny_bundle

from cap4d.avatar.deformer import Deformer as TorchDeformer
from cap4d.bundle import Bundle, read_bundle, write_bundle
from cap4d.camera import opencv_from_rig
from cap4d.drive.clip import Clip
from cap4d.export.deformer import export_deformer
from cap4d.export.distill import answers, distill
from cap4d.export.expressions import ALIKE, HELD_OUT_FRAMES, Expressions, offset_maps, own_expressions
from cap4d.export.tiers import tier_errors, with_tiers
from cap4d.player.deformer import Deformer
from cap4d.player.tiers import moving_subject


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    """A random U-Net that answers millimetres, on a grid of 16 px; eyes and an expression turn joints."""
    bundle = tiny_bundle(16, network=False)
    valid = np.zeros((16, 16), bool)
    valid[tuple(bundle.grid.pixels.T)] = True
    net = trained_looking(TorchDeformer(valid, width=8, generator=torch.Generator().manual_seed(0)))
    net.model.model[-1].weight.data *= 3
    model = export_deformer(net)
    neutral = bundle.grid.from_map(Deformer(model, size=16)(np.zeros((3, 16, 16), np.float32)))
    return replace(bundle, deform_onnx=model, deform_neutral=np.ascontiguousarray(neutral))


def test_a_network_of_lines_is_recovered_before_skinning(bundle: Bundle) -> None:
    rng = np.random.default_rng(0)
    truth = 1e-3 * rng.normal(size=bundle.subject.expression_basis.shape) * bundle.grid.deformable[:, None]
    wanted = replace(bundle, deform_linear=truth.astype(np.float32))
    fit, held_out = own_expressions(bundle)
    answer = pretended_network(wanted, fit.all(), held_out.all())
    found = distill(bundle, answer, fit)
    np.testing.assert_allclose(found, truth, atol=2e-6)
    assert np.abs(bundle.subject.skin_weights[bundle.grid.deformable]).max() > 0.5, "joints turn some of it"


def pretended_network(bundle: Bundle, *all_expressions: Expressions):
    """A network that moves the vertices as the bundle's lines do; it knows expressions by their maps."""
    known = {}
    for expressions in all_expressions:
        moments = zip(expressions.expr, expressions.eye_rot, expressions.jaw_rot, strict=True)
        for offsets, (expr, eyes, jaw) in zip(offset_maps(bundle, expressions), moments, strict=True):
            with_lines, without = (
                s.pose(expr, eye_rot=eyes, jaw_rot=jaw)
                for s in (moving_subject(bundle, "linear"), bundle.subject)
            )
            moved = opencv_from_rig(with_lines - without) + bundle.deform_neutral
            known[offsets.tobytes()] = bundle.grid.to_map(moved)
    return lambda offsets: known[offsets.tobytes()]


def test_a_real_network_is_followed_better_than_by_standing_still(bundle: Bundle) -> None:
    fit, held_out = own_expressions(bundle)
    network = Deformer(bundle.deform_onnx, size=16)
    linear = replace(bundle, deform_linear=distill(bundle, network, fit))
    assert not linear.deform_linear[:, ~bundle.grid.deformable].any()
    for kind in ("frames", "jittered", "singles"):
        errors = tier_errors(linear, getattr(held_out, kind))
        print(kind, errors)
        assert errors["off"][0] > 0.2, "the network moves something"
        # A random network is far from linear: a trained one keeps a quarter of the error (0.05 of 0.18 mm).
        assert errors["linear"][0] < 0.85 * errors["off"][0]


def test_every_tier_is_made_measured_and_stored(bundle: Bundle, tmp_path) -> None:
    made = with_tiers(bundle)
    assert made.tiers == ("full", "int8", "linear", "off")
    errors = made.tier_errors
    assert list(errors) == ["fp16", "int8", "linear", "off"]
    assert 0 < errors["fp16"][0] < errors["int8"][0] < errors["linear"][0] < errors["off"][0]
    assert all(rms <= worst for rms, worst in errors.values())
    write_bundle(made, tmp_path / "a.cap4d")
    read = read_bundle(tmp_path / "a.cap4d")
    assert read.tiers == made.tiers
    np.testing.assert_array_equal(read.deform_linear, made.deform_linear)
    for tier, pair in read.tier_errors.items():
        np.testing.assert_allclose(pair, errors[tier], rtol=1e-4)
    again = with_tiers(replace(bundle, tier_errors={"full": (1e-6, 1e-5), "int8": (9.0, 9.0)}))
    assert again.tier_errors == {"full": (1e-6, 1e-5), **errors}
    np.testing.assert_array_equal(again.deform_linear, made.deform_linear)
    bare = replace(bundle, deform_onnx=None)
    assert with_tiers(bare) is bare


def test_answers_are_what_moves_beyond_the_neutral_face(bundle: Bundle) -> None:
    zeros = np.zeros((1, 3), np.float32)
    still = Expressions(np.zeros((1, bundle.n_expressions), np.float32), zeros, zeros)
    found = answers(bundle, Deformer(bundle.deform_onnx, size=16), still)
    np.testing.assert_allclose(found, 0, atol=1e-8)


def test_no_frame_is_both_learned_from_and_measured_on() -> None:
    bundle = tiny_bundle(16, network=False)
    rng = np.random.default_rng(0)
    zeros = np.zeros((400, 3), np.float32)
    expr = rng.uniform(0, 1, (400, 5)).astype(np.float32)
    expr[100 : 100 + len(bundle.idle)] = bundle.idle.expr  # the idle clip is a piece of the capture
    capture = Clip(bundle.rig_name, 30.0, expr, zeros, zeros, zeros)
    fit, held_out = own_expressions(bundle, [capture])
    assert 0 < len(held_out.frames) <= HELD_OUT_FRAMES and len(fit.frames) > len(held_out.frames)
    nearest = np.abs(fit.frames.expr[:, None] - held_out.frames.expr).max(2).min()
    assert nearest > ALIKE
    low, high = bundle.expression_range.T
    assert (fit.jittered.expr >= np.minimum(low, fit.frames.expr)).all()
    assert (fit.jittered.expr <= np.maximum(high, fit.frames.expr)).all()
    assert sorted(set(fit.singles.expr[fit.singles.expr != 0])) == [0.5, 1.0]
    assert (np.count_nonzero(fit.singles.expr, axis=1) == 1).all()


@pytest.mark.parametrize("frames", [1, 2, 40])
def test_a_short_clip_is_enough(frames: int) -> None:
    bundle = tiny_bundle(16, network=False)
    idle = bundle.idle
    cut = {n: getattr(idle, n)[:frames] for n in ("expr", "eye_rot", "neck_rot", "jaw_rot")}
    fit, held_out = own_expressions(replace(bundle, idle=Clip(idle.rig_name, idle.fps, **cut)))
    assert len(fit.frames) and len(held_out.frames)
    assert np.isfinite(distill(bundle, lambda offsets: 0 * offsets, fit)).all()


def test_a_displacement_is_skinned_by_the_transform() -> None:
    subject = tiny_bundle(16, network=False).subject.map(lambda a: a.astype(np.float64))
    rng = np.random.default_rng(0)
    pose = dict(eye_rot=np.array([0.3, -0.2, 0.1]), neck_rot=np.array([0.2, 0.4, 0.0]))
    expr, moved = rng.uniform(0, 1, 5), 1e-3 * rng.normal(size=subject.neutral.shape)
    there = replace(subject, neutral=subject.neutral + moved).pose(expr, **pose) - subject.pose(expr, **pose)
    transforms = subject.skin_transform(expr, **pose)
    np.testing.assert_allclose(there, np.einsum("vij,vj->vi", transforms, moved), atol=1e-12)
    np.testing.assert_array_equal(
        subject.skin_transform(0 * expr), np.broadcast_to(np.eye(3), transforms.shape)
    )
