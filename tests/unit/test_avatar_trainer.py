"""What a step must be: the same every time."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_avatar import tiny_avatar, tiny_camera, tiny_rig, write_tiny_capture

from cap4d.avatar import fit as fit_module
from cap4d.avatar.corrections import Uncorrected
from cap4d.avatar.fit import fit, memory, run
from cap4d.avatar.presets import PRESETS
from cap4d.avatar.trainer import Trainer, rotation_term
from cap4d.avatar.views import FitView
from cap4d.capture.capture import Capture
from cap4d.errors import ArgumentError, Cap4dError

SIDE = 120  # vertices a side: 28k triangles, as a real grid has


def test_the_rotation_term_gives_the_same_gradient_bits_on_two_threads():
    generator = torch.Generator().manual_seed(0)
    row, column = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    flat = torch.stack([column, row, 0 * row], -1).reshape(-1, 3) * 0.002
    surface = flat + 2e-4 * torch.randn(flat.shape, generator=generator)
    corner = (row * SIDE + column)[:-1, :-1].reshape(-1)
    faces = torch.stack([corner, corner + SIDE, corner + SIDE + 1], 1)
    faces = torch.cat([faces, torch.stack([corner, corner + SIDE + 1, corner + 1], 1)])
    faces = faces[torch.randperm(len(faces), generator=generator)]  # neighbours meet on different threads
    moved = 1e-3 * torch.randn(flat.shape, generator=generator)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        gradients = []
        for _ in range(8):
            leaf = moved.clone().requires_grad_()
            rotation_term(surface, leaf, torch.zeros_like(leaf), faces).backward()
            gradients.append(leaf.grad)
    finally:
        torch.set_num_threads(threads)
    assert gradients[0].abs().max() > 0
    assert all(torch.equal(gradients[0], other) for other in gradients[1:])


def test_an_output_without_a_folder_is_refused_before_any_work(tmp_path: Path):
    with pytest.raises(ArgumentError, match="output: expected a file in a folder that exists"):
        fit([tmp_path / "no capture"], None, tmp_path / "nowhere" / "x.cap4d")


@pytest.fixture
def trainer(tmp_path):
    write_tiny_capture(tmp_path / "sheet", frames=3, size=16)
    capture = Capture.load(tmp_path / "sheet")
    view = FitView(0, 1, tiny_camera(16), torch.rand(16, 16, 3).half(), None)
    return Trainer(tiny_avatar(tiny_rig()), [Uncorrected(capture)], [view], PRESETS["debug"], seed=0)


def test_slow_steps_are_saved_before_their_turn(trainer, monkeypatch):
    trainer.preset = replace(trainer.preset, iterations=5, checkpoint_every=4)
    saved = []
    run(trainer, lambda: saved.append(trainer.step))
    assert saved == [4]
    monkeypatch.setattr(fit_module, "LOST_SECONDS", 0.0)
    trainer.step, saved[:] = 0, []
    run(trainer, lambda: saved.append(trainer.step))
    assert saved == [1, 2, 3, 4, 5]


def test_the_gpus_memory_is_told(monkeypatch):
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: 3 * 2**20)
    assert re.fullmatch(r"\d+ MB \+ 3 MB on the GPU", memory(torch.device("cuda")))
    assert re.fullmatch(r"\d+ MB", memory(torch.device("cpu")))


def test_a_loss_that_is_not_finite_ends_the_fit_and_spoils_nothing(trainer):
    trainer.advance()
    before = [p.detach().clone() for p in trainer.model.parameters()]
    view = trainer.views[0]
    trainer.views = [replace(view, pixels=view.pixels * float("nan"))]
    with pytest.raises(Cap4dError, match="step 1: the loss is nan in frame 1 of capture 1"):
        trainer.advance()
    assert trainer.step == 1
    assert all(torch.equal(a, b) for a, b in zip(before, trainer.model.parameters(), strict=True))


def test_a_state_whose_sizes_do_not_fit_is_refused(trainer):
    trainer.advance()
    state = trainer.state()
    trainer.restore(state)
    beyond = state["binding"].clone()
    beyond[3] = len(trainer.faces)
    few = {**state["gaussians"], "quats": state["gaussians"]["quats"][1:]}
    for change, said in (
        ({"binding": beyond}, "binding"),
        ({"binding": -beyond}, "binding"),
        ({"gaussians": few}, "gaussians"),
        ({"evidence": [x[1:] for x in state["evidence"]]}, "gaussians"),
    ):
        with pytest.raises(ValueError, match=said):
            trainer.restore({**state, **change})
