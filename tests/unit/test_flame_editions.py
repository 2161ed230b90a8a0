"""Between FLAME's editions: exact within one, refused with a reason between two."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")

from drive_bundle import on_rig

from cap4d.drive.convert import Converter
from cap4d.drive.flame_editions import convert_expression, same_basis
from cap4d.drive.packet import Cause, Packet, Rejected
from cap4d.errors import ArgumentError
from cap4d.rig.head import HeadRig

NAMES = (*(f"expr{i:02d}" for i in range(64)), "blink")
RNG = np.random.default_rng(0)


def draw(n: int) -> np.ndarray:
    return RNG.normal(size=n).astype(np.float32)


def test_the_same_length_passes_untouched() -> None:
    expr = draw(65)
    assert convert_expression(expr, "flame2023_no_jaw", "flame2023_no_jaw", NAMES) is expr


@pytest.mark.parametrize("n", [10, 50, 64, 100])
def test_more_or_fewer_components_of_the_same_edition(n: int) -> None:
    expr = draw(n)
    found = convert_expression(expr, "generic_model", "flame2020", NAMES)
    shared = min(n, 64)
    assert np.array_equal(found[:shared], expr[:shared]) and not found[shared:].any(), (
        "no blink out of a component"
    )


def test_the_released_systems_blink_is_no_component() -> None:
    bare = tuple(f"expr{i:02d}" for i in range(100))
    found = convert_expression(draw(65), "flame2023_no_jaw", "flame2023_no_jaw", bare)
    assert found.shape == (100,) and found[:64].all() and not found[64:].any()


@pytest.mark.parametrize("target", ["flame2023", "flame2023_no_jaw"])
def test_another_basis_is_refused_and_says_what_to_send(target: str) -> None:
    with pytest.raises(Rejected, match=f"{target}, got flame2020.*send vertices") as caught:
        convert_expression(draw(65), "flame2020", target, NAMES)
    assert caught.value.cause == Cause.RIG


def test_lengths_that_no_edition_has_are_refused() -> None:
    for n in (0, 101, 5000):
        with pytest.raises(Rejected) as caught:
            convert_expression(draw(n), "flame2020", "flame2020", NAMES)
        assert caught.value.cause == Cause.SHAPE


def test_same_basis() -> None:
    assert same_basis("builtin", "builtin") and same_basis("generic_model", "flame2020")
    assert not same_basis("flame2020", "flame2023") and not same_basis("flame2023", "flame2023_no_jaw")


@pytest.fixture(scope="module")
def standin(shared: Path) -> HeadRig:
    from cap4d.rig.flame import import_flame

    return import_flame(shared / "flame/flame_standin.pkl", shared / "flame/cap4d_assets")


def another_basis(rig: HeadRig, name: str) -> HeadRig:
    """The same faces by other coefficients: a mixture of the basis, as of editions learnt from like data."""
    mix, _ = np.linalg.qr(RNG.normal(size=(64, 64)))
    basis = rig.expression_basis.copy()
    basis[:64] = np.tensordot(mix.astype(np.float32), basis[:64], 1)
    turns = np.concatenate([mix @ rig.expr_rotation[:64], rig.expr_rotation[64:]]).astype(np.float32)
    joints = rig.joints_expression.copy()
    joints[:64] = np.tensordot(mix.astype(np.float32), joints[:64], 1)
    return replace(rig, name=name, expression_basis=basis, expr_rotation=turns, joints_expression=joints)


def test_with_the_senders_model_expressions_carry_over(standin: HeadRig) -> None:
    bundle, sender = on_rig(standin), another_basis(standin, "flame2023")
    expr = draw(65)
    sent = Packet(0, "flame2023", expr)
    with pytest.raises(Rejected):
        Converter(bundle)(sent)
    convert = Converter(bundle, sender=sender)
    frame = convert(sent)
    wanted = sender.subject().pose(expr)[:5023]
    apart = np.linalg.norm(standin.subject().pose(frame.expr)[:5023] - wanted, axis=1)
    print(f"{1e3 * apart.max():.4f} mm apart at worst; residual {convert.residual_mm:.4f} mm")
    assert apart.max() < 2e-4 and convert.residual_mm < 0.01
    assert np.array_equal(convert(Packet(0, standin.name, expr)).expr, expr), "the avatar's own still pass"
    short = convert(Packet(0, "flame2023", expr[:50])).expr
    assert np.allclose(short, convert(Packet(0, "flame2023", expr * (np.arange(65) < 50))).expr)


def test_a_jaw_becomes_expression_where_there_is_none(standin: HeadRig) -> None:
    """And stays a jaw where there is one."""
    turn = np.array([0.15, 0, 0], np.float32)
    sender = replace(standin, name="flame2020")
    packet = Packet(0, "flame2020", np.zeros(65, np.float32), jaw_rot=turn)
    convert = Converter(on_rig(standin), sender=sender)
    frame = convert(packet)
    assert not frame.jaw_rot.any() and frame.expr[0] > 0.5 and convert.residual_mm > 0.1
    kept = replace(standin, name="flame2023")
    frame = Converter(on_rig(kept), sender=sender)(packet)
    assert np.array_equal(frame.jaw_rot, turn) and np.abs(frame.expr).max() < 1e-3


def test_maps_refuse_what_they_are_not_for(standin: HeadRig, builtin_rig: HeadRig) -> None:
    bundle = on_rig(standin)
    with pytest.raises(ArgumentError, match="two editions of FLAME"):
        Converter(bundle, sender=builtin_rig)
    convert = Converter(bundle, sender=another_basis(standin, "flame2020"))
    for expr, cause in (
        (draw(66), Cause.SHAPE),
        (draw(0), Cause.SHAPE),
        (np.float32([np.nan]), Cause.NOT_FINITE),
    ):
        with pytest.raises(Rejected) as caught:
            convert(Packet(0, "flame2020", expr))
        assert caught.value.cause == cause
    assert np.isfinite(convert(Packet(0, "flame2020", np.full(65, 3e38, np.float32))).expr).all()
    with pytest.raises(Rejected):
        convert(Packet(0, "flame2023", draw(65)))
