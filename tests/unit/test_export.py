"""The ONNX network answers as torch does, the bundle plays what was fitted, idle clips do not jump."""

from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from tiny_avatar import tiny_avatar, tiny_camera, tiny_rig

from cap4d.avatar.deformer import DEFORM_STD, Deformer, downsamplings
from cap4d.avatar.model import Pose
from cap4d.bundle import read_bundle
from cap4d.bundle.onnx_half import halve_weights
from cap4d.bundle.onnx_scan import scan_onnx
from cap4d.capture.capture import Capture
from cap4d.drive.clip import Clip
from cap4d.errors import ArgumentError, Cap4dError
from cap4d.export import bundle as bundle_module
from cap4d.export.bundle import export_bundle
from cap4d.export.deformer import export_deformer, worst_difference
from cap4d.export.idle import SHUT, blinking, idle_clip, is_film, looped
from cap4d.export.unet_onnx import network_weights, unet_onnx


def trained_looking(deformer, seed=0):
    """A network whose last layer is not zero any more."""
    generator = torch.Generator().manual_seed(seed)
    torch.nn.init.normal_(deformer.model.model[-1].weight, std=0.02, generator=generator)
    torch.nn.init.normal_(deformer.model.model[-1].bias, std=0.1, generator=generator)
    return deformer


@pytest.mark.parametrize(("size", "width"), [(16, 4), (64, 8), (128, 16)])
def test_onnx_answers_as_torch_does(size, width):
    generator = torch.Generator().manual_seed(0)
    valid = np.random.default_rng(0).random((size, size)) < 0.8
    net = trained_looking(Deformer(valid, width=width, generator=generator))
    offsets = torch.randn(3, 3, size, size, generator=generator) * DEFORM_STD
    data = export_deformer(net)
    assert worst_difference(data, net, offsets) < 1e-5
    net.model.model[-1].bias.data += 1.0
    assert worst_difference(data, net, offsets) > 1e-2


def test_onnx_is_self_contained_and_small():
    net = trained_looking(Deformer(np.ones((32, 32), bool), width=4))
    data = export_deformer(net)
    weights = sum(p.numel() for p in net.parameters())
    assert len(data) < 4 * (weights + 32 * 32 + 24 * 32) + 8000
    summary = scan_onnx(data, source="deform.onnx", size=32)
    assert summary.opset == 17
    assert not any(t.external_data for t in onnx.load_from_string(data).graph.initializer)


def test_weights_keep_the_names_and_layout_of_the_released_state_dicts():
    net = trained_looking(Deformer(np.ones((32, 32), bool), width=4))
    weights = network_weights(export_deformer(net))
    for name, value in net.state_dict().items():
        np.testing.assert_array_equal(weights[name], value.numpy())


def test_the_positional_encoding_costs_nothing_per_frame(tmp_path):
    options = onnxruntime.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "optimised.onnx")
    options.log_severity_level = 4
    net = trained_looking(Deformer(np.ones((64, 64), bool), width=4))
    onnxruntime.InferenceSession(export_deformer(net), options, providers=["CPUExecutionProvider"])
    nodes = [n.op_type for n in onnx.load(tmp_path / "optimised.onnx").graph.node]
    assert nodes.count("Conv") == nodes.count("ConvTranspose") == downsamplings(64)
    assert not {"Expand", "Slice"} & set(nodes)


def test_a_network_from_before_is_rewritten_to_the_same_answers():
    net = trained_looking(Deformer(np.ones((32, 32), bool), width=4))
    offsets = torch.randn(2, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * DEFORM_STD
    data = export_deformer(net)
    assert unet_onnx(network_weights(data)) == data
    half = unet_onnx(network_weights(halve_weights(data)))
    assert 1e-6 < worst_difference(half, net, offsets) < 1e-2
    scan_onnx(half, source="deform.onnx", size=32)
    with pytest.raises(ArgumentError, match=r"expected the weights of a U-Net, 'model\.model\.3\.weight' is"):
        unet_onnx({k: v for k, v in network_weights(data).items() if k != "model.model.3.weight"})


def capture_and_clip(tmp_path, frames=40):
    t = np.linspace(0, 2 * np.pi, frames)
    expr = np.stack([0.5 + 0.5 * np.sin(t), np.cos(t)], -1).astype(np.float32)
    zero = np.zeros((frames, 3), np.float32)
    tra = np.tile(np.float32([0, 0, -0.5]), (frames, 1))
    poses = dict(eye_rot=zero, neck_rot=zero, jaw_rot=zero, rot=zero, tra=tra)
    camera = tiny_camera(32)
    capture = Capture(
        tmp_path, "tiny", np.zeros(1, np.float32), expr, cameras={"cam0": camera}, fps=20.0, views=(), **poses
    )
    return capture, capture.clip()


def test_the_player_poses_what_was_fitted(tmp_path):
    import cap4d

    rig = tiny_rig()
    model = tiny_avatar(rig)
    trained_looking(model.deformer)
    capture, _ = capture_and_clip(tmp_path)
    path = tmp_path / "tiny.cap4d"
    export_bundle(model, path, rig=rig, capture=capture)
    avatar = cap4d.Avatar.load(path)
    expr, neck = np.float32([0.7, -0.4]), np.float32([0.1, -0.05, 0.02])
    zero = torch.zeros(3)
    with torch.no_grad():
        posed = model.pose(Pose(torch.from_numpy(expr), zero, torch.from_numpy(neck), zero))
    gaussians = avatar.pose(expr, neck_rot=neck)
    np.testing.assert_allclose(gaussians.means, posed.means.numpy(), atol=2e-6)
    np.testing.assert_allclose(gaussians.scales, posed.scales.numpy(), rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(gaussians.opacities, posed.opacities.numpy(), atol=1e-6)
    bundle = read_bundle(path)
    assert np.abs(bundle.deform_neutral).max() > 1e-4
    assert bundle.tiers == ("full", "int8", "linear", "off")
    rms, worst = bundle.tier_errors["full"]
    assert 0 < rms <= worst < 1e-4, "float32 against float64, mm"


def test_the_cheaper_deformers_can_be_left_out(tmp_path):
    model = tiny_avatar(tiny_rig())
    trained_looking(model.deformer)
    capture, _ = capture_and_clip(tmp_path)
    export_bundle(model, tmp_path / "x.cap4d", rig=tiny_rig(), capture=capture, tiers=False)
    assert read_bundle(tmp_path / "x.cap4d").tiers == ("full", "off")


def test_an_export_that_differs_is_refused(tmp_path, monkeypatch):
    rig = tiny_rig()
    model = tiny_avatar(rig)
    trained_looking(model.deformer)
    capture, _ = capture_and_clip(tmp_path)
    other = export_deformer(trained_looking(tiny_avatar(rig, seed=5).deformer, seed=9))
    monkeypatch.setattr(bundle_module, "export_deformer", lambda deformer: other)
    with pytest.raises(Cap4dError, match=r"deform\.onnx: expected within 1e-05 of torch"):
        export_bundle(model, tmp_path / "x.cap4d", rig=rig, capture=capture)
    assert not list(tmp_path.glob("*.cap4d"))


def test_a_loop_has_no_jump(tmp_path):
    _, clip = capture_and_clip(tmp_path)
    drift = replace(clip, rot=np.linspace(0, 1, 40, dtype=np.float32)[:, None].repeat(3, 1))
    loop = looped(drift)
    steps = np.abs(np.diff(np.concatenate([loop.rot, loop.rot[:1]]), axis=0)).max(1)
    assert len(loop) == 30
    assert steps.max() < 0.15  # the whole way back in half a second, not in one frame
    np.testing.assert_array_equal(loop.rot[:20], drift.rot[10:30])


def test_stills_get_an_invented_clip_with_the_head_in_place(tmp_path):
    rng = np.random.default_rng(0)
    _, film = capture_and_clip(tmp_path)
    stills = replace(film, expr=rng.normal(0, 1, film.expr.shape).astype(np.float32))
    assert is_film(film)
    assert not is_film(stills)
    clip = idle_clip(stills, tiny_rig())
    assert isinstance(clip, Clip)
    assert clip.rig_name == "tiny"
    assert clip.duration > 2
    assert (clip.tra == stills.tra[0]).all()
    assert len(idle_clip(film, tiny_rig())) == 30


def test_a_film_without_blinks_is_given_some_and_one_with_blinks_is_left_alone(builtin_rig):
    from cap4d.synth.idle import expression_vector

    lids = expression_vector(builtin_rig, {"eyeBlink": 1.0}) > 0
    turns = {name: np.zeros((120, 3), np.float32) for name in ("eye_rot", "neck_rot", "jaw_rot")}
    still = Clip("builtin", 30.0, np.full((120, len(lids)), 0.1, np.float32), **turns)
    clip = blinking(still, builtin_rig)
    shut = clip.expr[:, lids].mean(1)
    assert shut.max() > 0.9 and np.median(shut) < 0.2
    np.testing.assert_array_equal(clip.expr[:, ~lids], still.expr[:, ~lids])
    assert shut.max() > SHUT
    assert blinking(clip, builtin_rig) is clip
