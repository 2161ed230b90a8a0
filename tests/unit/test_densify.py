"""Densification keeps parameters, binding and Adam's moments aligned, and every face alive."""

from dataclasses import replace

import pytest
import torch
from tiny_avatar import tiny_avatar, tiny_rig

from cap4d.avatar.densify import Evidence, Rows, densify, reset_opacity
from cap4d.avatar.presets import Densify

SETTINGS = Densify(start=0, stop=100, every=10, gradient=1.0, most=10_000, split_scale=1e9)


@pytest.fixture
def table():
    """A model whose rows carry their number in a colour, in both moments, and in their binding's."""
    model = tiny_avatar(tiny_rig(), width=None)
    n = len(model)
    number = torch.arange(n, dtype=torch.float32)
    model.gaussians["sh_dc"].data[:, 0, 0] = number
    optimizer = torch.optim.Adam([{"params": [p]} for p in model.gaussians.values()], lr=0.0)
    sum(p.sum() for p in model.gaussians.values()).backward()
    optimizer.step()
    state = optimizer.state[model.gaussians["sh_dc"]]
    state["exp_avg"][:, 0, 0] = number
    state["exp_avg_sq"][:, 0, 0] = 2 * number
    return Rows(model, optimizer), model.binding.clone()


def run(rows, evidence, settings, per_face=1, room=1000, worth=None):
    faces = len(rows.model.faces)
    sizes = torch.full((faces,), 0.01)
    generator = torch.Generator().manual_seed(0)
    densify(
        rows,
        evidence,
        settings,
        face_sizes=sizes,
        step=50,
        room=room,
        per_face=per_face,
        generator=generator,
        worth=worth,
    )


def check_alignment(rows, first_binding, fresh):
    """Every row still belongs to the one it came from; `fresh` rows at the end have no moments."""
    model, optimizer = rows.model, rows.optimizer
    number = model.gaussians["sh_dc"][:, 0, 0].detach()
    assert torch.equal(model.binding, first_binding[number.long()])
    assert {len(p) for p in model.gaussians.values()} == {len(model.binding)}
    known = {id(p) for group in optimizer.param_groups for p in group["params"]}
    assert known == {id(p) for p in model.gaussians.values()}
    assert {id(p) for p in optimizer.state} == known
    state = optimizer.state[model.gaussians["sh_dc"]]
    old = len(number) - fresh
    assert torch.equal(state["exp_avg"][:old, 0, 0], number[:old])
    assert torch.equal(state["exp_avg_sq"][:old, 0, 0], 2 * number[:old])
    assert not state["exp_avg"][old:].any()
    loss = sum(p.square().sum() for p in model.gaussians.values())
    loss.backward()
    optimizer.step()


def test_cloning_what_is_pulled_at(table):
    rows, binding = table
    evidence = Evidence(len(rows.model))
    evidence.seen += 2
    evidence.gradient[[3, 7]] = 5.0
    evidence.gradient[9] = 1.0  # a mean of a half: below the threshold
    n = len(rows.model)
    before = rows.model.gaussians["means"].detach().clone()
    run(rows, evidence, SETTINGS)
    assert len(rows.model) == n + 2
    assert torch.equal(rows.model.gaussians["means"][-2:], before[[3, 7]])
    check_alignment(rows, binding, fresh=2)


def test_splitting_replaces_the_parent_by_two_smaller_ones(table):
    rows, binding = table
    evidence = Evidence(len(rows.model))
    evidence.seen += 1
    evidence.gradient[5] = 5.0
    n, parent = len(rows.model), rows.model.gaussians["log_scales"][5].detach().clone()
    run(rows, evidence, replace(SETTINGS, split_scale=0.0))
    assert len(rows.model) == n + 1
    number = rows.model.gaussians["sh_dc"][:, 0, 0]
    assert not (number[:-2] == 5).any()
    assert (number[-2:] == 5).all()
    children = rows.model.gaussians["log_scales"][-2:].detach()
    torch.testing.assert_close(children.exp() * 1.6, parent.exp().expand(2, 3))
    means = rows.model.gaussians["means"][-2:]
    assert not torch.equal(means[0], means[1])
    check_alignment(rows, binding, fresh=2)


def test_in_world_units_children_stay_where_their_parent_was(table):
    """The released code's offset is a face size, here 1 cm, times too short (fact 30)."""
    rows, _ = table
    evidence = Evidence(len(rows.model))
    evidence.seen += 1
    evidence.gradient[5] = 5.0
    parent = {name: value.detach()[5].clone() for name, value in rows.model.gaussians.items()}
    everything = {n: p.detach().clone() for n, p in rows.model.gaussians.items()}
    binding = rows.model.binding.clone()
    offsets = {}
    for units in ("local", "world"):
        for name, value in everything.items():
            rows.model.gaussians[name] = torch.nn.Parameter(value.clone())
        rows.model.binding = binding.clone()
        model = Rows(rows.model, torch.optim.Adam(rows.model.gaussians.values()))
        run(model, evidence, replace(SETTINGS, split_scale=0.0, split_offset=units))
        offsets[units] = rows.model.gaussians["means"][-2:].detach() - parent["means"]
    torch.testing.assert_close(offsets["world"], 0.01 * offsets["local"], rtol=1e-4, atol=1e-7)
    assert 0.2 < (offsets["local"] / parent["log_scales"].exp()).square().mean().sqrt() < 3


def test_what_is_worth_least_goes_and_makes_room(table):
    rows, binding = table
    n = len(rows.model)
    evidence = Evidence(n)
    evidence.seen += 1
    evidence.gradient[:20] = torch.arange(20.0) + 2
    worth = torch.arange(n, dtype=torch.float32).flip(0)
    few = int(0.01 * n)
    run(rows, evidence, replace(SETTINGS, prune_least=0.01), per_face=0, room=3, worth=worth)
    number = rows.model.gaussians["sh_dc"][:, 0, 0].detach()
    assert len(number) == n + 3
    assert set(range(n)) - set(number.int().tolist()) == set(range(n - few, n))
    assert sorted(number[-3 - few :].tolist()) == list(range(20 - 3 - few, 20))
    check_alignment(rows, binding, fresh=3 + few)


def test_without_a_budget_the_threshold_alone_decides(table):
    rows, _ = table
    n = len(rows.model)
    evidence = Evidence(n)
    evidence.seen += 1
    evidence.gradient[: n // 2] = 2.0
    run(rows, evidence, SETTINGS, room=None)
    assert len(rows.model) == n + n // 2


def test_the_budget_takes_the_most_wanted(table):
    rows, binding = table
    evidence = Evidence(len(rows.model))
    evidence.seen += 1
    evidence.gradient[:20] = torch.arange(20.0) + 2
    run(rows, evidence, SETTINGS, room=3)
    assert sorted(rows.model.gaussians["sh_dc"][-3:, 0, 0].tolist()) == [17, 18, 19]
    check_alignment(rows, binding, fresh=3)


def test_pruning_leaves_the_most_opaque_of_every_face(table):
    rows, binding = table
    logits = rows.model.gaussians["opacity_logits"].data
    logits.fill_(-9.0)
    logits += torch.rand(len(logits), generator=torch.Generator().manual_seed(1))
    best = {int(f): float(logits[binding == f].max()) for f in binding.unique()}
    run(rows, Evidence(len(rows.model)), SETTINGS)
    left = rows.model.gaussians["opacity_logits"].detach()
    assert {int(f): float(x) for f, x in zip(rows.model.binding, left, strict=True)} == best
    check_alignment(rows, binding, fresh=0)


def test_without_a_floor_faces_may_empty(table):
    rows, binding = table
    rows.model.gaussians["opacity_logits"].data.fill_(-9.0)
    rows.model.gaussians["opacity_logits"].data[4] = 2.0
    run(rows, Evidence(len(rows.model)), SETTINGS, per_face=0)
    assert len(rows.model) == 1
    check_alignment(rows, binding, fresh=0)


def test_reset_lowers_opacities_and_forgets_their_moments(table):
    rows, _ = table
    rows.model.gaussians["opacity_logits"].data[0] = -8.0
    reset_opacity(rows)
    opacity = rows.model.gaussians["opacity_logits"].sigmoid()
    assert float(opacity.max().detach()) <= 0.01 + 1e-6
    assert float(opacity[0].detach()) < 1e-3
    assert not rows.optimizer.state[rows.model.gaussians["opacity_logits"]]["exp_avg"].any()


@pytest.mark.parametrize("least", [None, 0.01])
def test_everything_happens_on_the_models_device(table, least):
    """With another default device, whatever is made without asking where the model is cannot meet it."""
    rows, _ = table
    n = len(rows.model)
    evidence, generator = Evidence(n), torch.Generator().manual_seed(0)
    evidence.seen += 1
    evidence.gradient[:9] = 2.0
    world = rows.model.gaussians["log_scales"].detach().exp().amax(1) * 0.01
    settings = replace(SETTINGS, split_scale=float(world[:9].median()), prune_least=least or 0.0)
    worth = None if least is None else torch.arange(n, dtype=torch.float32)
    sizes = torch.full((len(rows.model.faces),), 0.01)
    with torch.device("meta"):
        densify(
            rows,
            evidence,
            settings,
            face_sizes=sizes,
            step=50,
            room=20,
            per_face=1,
            generator=generator,
            worth=worth,
        )
        reset_opacity(rows)
    assert {p.device.type for p in rows.model.parameters()} == {"cpu"}


def test_evidence_counts_only_where_visible():
    evidence = Evidence(3)
    evidence.add(torch.tensor([[3.0, 4.0], [1.0, 0.0], [9.0, 9.0]]), torch.tensor([2, 5, 0]))
    evidence.add(torch.tensor([[0.0, 1.0], [9.0, 0.0], [9.0, 9.0]]), torch.tensor([7, 0, 0]))
    torch.testing.assert_close(evidence.mean_gradient(), torch.tensor([3.0, 1.0, 0.0]))
    assert evidence.radius.tolist() == [7, 5, 0]
