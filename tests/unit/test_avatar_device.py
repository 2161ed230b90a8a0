"""What a fit does on a CUDA device, as far as a CPU can run it: the torch forms of what is in C++."""

from dataclasses import replace

import pytest
import torch
from test_avatar_bound import make_scene, outputs_and_gradients
from tiny_avatar import GRID, tiny_avatar, tiny_rig, write_tiny_capture

from cap4d.avatar import model as model_module
from cap4d.avatar.bound import bind_in_torch, bind_to
from cap4d.avatar.device import device_named
from cap4d.avatar.fit import prepare
from cap4d.avatar.presets import Densify, preset_named
from cap4d.avatar.views import load_views, split_views
from cap4d.capture.capture import Capture
from cap4d.errors import ArgumentError

STEPS = 12


def test_binding_in_torch_is_that_of_c():
    faces, inputs, binding, weights = make_scene(40, 60, 300)

    def by(function):
        def call(vertices, means, quats, log_scales):
            local = dict(means=means, quats=quats, log_scales=log_scales, binding=binding.int())
            return function(vertices, faces.int(), **local)

        return call

    expected = outputs_and_gradients(by(bind_to), inputs, weights, torch.float32)
    found = outputs_and_gradients(by(bind_in_torch), inputs, weights, torch.float32)
    for many, more in zip(expected, found, strict=True):
        for a, b in zip(many, more, strict=True):
            assert float((a - b).abs().max() / a.abs().max()) < 5e-6


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    path = tmp_path_factory.mktemp("captures") / "sheet"
    write_tiny_capture(path, size=24)
    return Capture.load(path)


def losses_of(capture, *, backend="auto"):
    preset = replace(
        preset_named("debug", "short"),
        image_size=24,
        grid_size=GRID,
        deformer_width=4,
        gaussians=600,
        densify=Densify(start=6, stop=6, every=6, most=700),
    )
    split = split_views([capture], load_views([capture], 24))
    trainer = prepare([capture], split, tiny_rig(), preset, ablate=None, seed=0)
    trainer.backend = backend
    return [trainer.advance() for _ in range(STEPS)], len(trainer.model)


def test_a_fit_in_torch_alone_goes_where_that_in_c_goes(capture, monkeypatch):
    expected = losses_of(capture)
    monkeypatch.setattr(model_module, "bind_to", bind_in_torch)
    monkeypatch.setattr("cap4d.avatar.deformer._is_fast", lambda *_: False)
    found = losses_of(capture, backend="reference")
    assert found[1] == expected[1]
    assert found[0] == pytest.approx(expected[0], rel=2e-3)
    assert expected[0][-1] < expected[0][0]


def test_the_subject_goes_where_the_model_goes():
    model = tiny_avatar(tiny_rig()).to("meta")
    tensors = (model.subject.neutral, model.subject.skin_weights, model.binding, model.gaussians["means"])
    assert {x.device.type for x in tensors} == {"meta"}


def test_a_device_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert device_named("auto").type == device_named("cpu").type == "cpu"
    with pytest.raises(ArgumentError, match="cuda needs a CUDA device, and torch finds none"):
        device_named("cuda")
    with pytest.raises(ArgumentError, match="device: expected auto, cpu, cuda"):
        device_named("tpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("cap4d.avatar.device.find_spec", lambda name: None)
    assert device_named("auto").type == "cpu"
    with pytest.raises(ArgumentError, match="cuda needs gsplat"):
        device_named("cuda")
    monkeypatch.setattr("cap4d.avatar.device.find_spec", lambda name: name)
    assert device_named("auto").type == "cuda"
