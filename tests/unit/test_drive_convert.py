"""Packets become frames of the avatar, or are refused with their cause."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")

from drive_bundle import on_rig
from tiny_bundle import EXPRESSIONS, RIG_NAME, tiny_bundle

from cap4d.bundle import Bundle
from cap4d.drive.arkit import COLUMN, NAMES
from cap4d.drive.convert import MAX_TURN, Converter
from cap4d.drive.packet import Cause, Packet, Rejected
from cap4d.errors import ArgumentError, DataError

E = len(EXPRESSIONS)


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return tiny_bundle(8, network=False)


@pytest.fixture
def convert(bundle: Bundle) -> Converter:
    return Converter(bundle)


def vec(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def refused(convert: Converter, packet: Packet) -> Cause:
    with pytest.raises(Rejected) as caught:
        convert(packet)
    assert caught.value.detail
    return caught.value.cause


def test_expressions_of_the_same_rig_pass_as_they_are(convert: Converter) -> None:
    expr = vec(0.1, 0.2, 0.3, 0.4, 0.5)
    turns = {name: vec(0.1, 0, 0) for name in ("eye_rot", "neck_rot", "jaw_rot", "rot")}
    frame = convert(Packet(3.5, RIG_NAME, expr, tra=vec(0, 0, -1), **turns))
    assert (frame.t, frame.rig_name) == (3.5, RIG_NAME)
    assert np.array_equal(frame.expr, expr) and frame.expr.dtype == np.float32
    assert all(np.array_equal(getattr(frame, name), turns[name]) for name in turns)
    assert np.array_equal(frame.tra, vec(0, 0, -1))


def test_what_the_sender_leaves_out_is_zero_or_none(convert: Converter) -> None:
    frame = convert(Packet(0, RIG_NAME, np.zeros(E, np.float32)))
    assert not (frame.eye_rot.any() or frame.neck_rot.any() or frame.jaw_rot.any())
    assert frame.rot is None and frame.tra is None
    turned = convert(Packet(0, RIG_NAME, np.zeros(E, np.float32), rot=vec(0, 0.2, 0)))
    assert np.array_equal(turned.tra, vec(0, 0, 0)), "a head that turns turns about its origin"


def test_the_neutral_frame(convert: Converter) -> None:
    frame = convert.neutral(7)
    assert frame.t == 7 and frame.expr.shape == (E,) and not frame.expr.any() and frame.rot is None


def test_arkit_by_name_with_gaze(convert: Converter) -> None:
    weights = np.zeros(len(NAMES), np.float32)
    weights[COLUMN["jawOpen"]], weights[COLUMN["eyeLookOutLeft"]], weights[COLUMN["eyeLookInRight"]] = (
        0.5,
        1,
        1,
    )
    frame = convert(Packet(0, arkit=weights))
    assert frame.expr[0] == 0.5 and not frame.expr[1:].any()
    assert np.allclose(np.degrees(frame.eye_rot), [0, 35, 0], atol=1e-3)
    own = convert(Packet(0, arkit=weights, eye_rot=vec(0.3, 0, 0)))
    assert np.array_equal(own.eye_rot, vec(0.3, 0, 0)), "angles that are sent win over weights"


def test_other_rigs_and_lengths_are_refused(convert: Converter, bundle: Bundle) -> None:
    assert refused(convert, Packet(0, "builtin", np.zeros(52, np.float32))) == Cause.RIG
    assert refused(convert, Packet(0, None, np.zeros(E, np.float32))) == Cause.RIG  # FLAME's, then
    assert refused(convert, Packet(0, RIG_NAME, np.zeros(E + 1, np.float32))) == Cause.SHAPE
    assert refused(convert, Packet(0, RIG_NAME, np.zeros((1, E), np.float32))) == Cause.FIELD
    assert refused(convert, Packet(0)) == Cause.FIELD
    assert refused(convert, Packet(0, arkit=np.zeros(51, np.float32))) == Cause.SHAPE
    assert refused(convert, Packet(0, vertices=np.zeros((7, 3), np.float32))) == Cause.SHAPE
    nameless = replace(bundle, subject=replace(bundle.subject, expression_names=tuple("abcde")))
    assert refused(Converter(nameless), Packet(0, arkit=np.zeros(52, np.float32))) == Cause.RIG


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_poison_is_refused_wherever_it_is(convert: Converter, bundle: Bundle, poison: float) -> None:
    bad, good = vec(0, poison, 0), np.zeros(E, np.float32)
    assert refused(convert, Packet(0, RIG_NAME, np.full(E, poison, np.float32))) == Cause.NOT_FINITE
    for name in ("eye_rot", "neck_rot", "jaw_rot", "rot", "tra"):
        extra = {"rot": vec(0, 0, 0)} if name == "tra" else {}
        assert refused(convert, Packet(0, RIG_NAME, good, **extra, **{name: bad})) == Cause.NOT_FINITE
    weights = np.zeros(52, np.float32)
    weights[3] = poison
    assert refused(convert, Packet(0, arkit=weights)) == Cause.NOT_FINITE
    vertices = bundle.mesh_subject.neutral.copy()
    vertices[5, 1] = poison
    assert refused(convert, Packet(0, vertices=vertices)) == Cause.NOT_FINITE


def test_finite_nonsense_is_brought_within_reach(convert: Converter) -> None:
    huge = np.float32(3e38)
    frame = convert(Packet(0, RIG_NAME, np.full(E, huge), rot=vec(huge, -huge, huge), tra=vec(huge, 0, 0)))
    assert frame.expr.max() == 3, "the range, 0 to 1, and twice its width"
    assert np.linalg.norm(frame.rot) <= MAX_TURN * 1.001 and frame.tra[0] == 100
    assert np.isfinite(convert(Packet(0, arkit=np.full(52, -huge))).expr).all()


def test_vertices_of_a_known_template(bundle: Bundle, caplog: pytest.LogCaptureFixture) -> None:
    mesh = bundle.mesh_subject
    convert = Converter(bundle, template=mesh.pose(np.zeros(E, np.float32)))
    expr = vec(0.5, 0.1, 0.9, 0, 0.3)
    frame = convert(Packet(0, vertices=mesh.pose(expr)))
    rebuilt = bundle.subject.pose(frame.expr) - bundle.subject.pose(expr)
    assert np.abs(rebuilt).max() < 1e-3 and convert.residual_mm is not None
    assert not caplog.records


def test_without_a_template_the_first_frame_is_neutral_and_that_is_said_once(
    bundle: Bundle, caplog: pytest.LogCaptureFixture
) -> None:
    mesh, convert = bundle.mesh_subject, Converter(bundle)
    for i in range(3):
        frame = convert(Packet(i, vertices=mesh.neutral))
        assert not frame.expr.any() and convert.residual_mm == 0
    said = [r for r in caplog.records if r.levelno == logging.WARNING]
    assert len(said) == 1 and "neutral" in said[0].getMessage()


def test_meshes_that_are_no_face(bundle: Bundle) -> None:
    mesh = bundle.mesh_subject
    assert (
        refused(Converter(bundle), Packet(0, vertices=1000 * mesh.neutral)) == Cause.RETARGET
    )  # millimetres
    convert = Converter(bundle, template=mesh.neutral)
    assert refused(convert, Packet(0, vertices=mesh.neutral + np.float32(1))) == Cause.RETARGET
    noise = np.random.default_rng(0).normal(0, 0.1, mesh.neutral.shape).astype(np.float32)
    assert refused(convert, Packet(0, vertices=mesh.neutral + noise)) == Cause.RETARGET
    assert refused(convert, Packet(0, vertices=np.full_like(mesh.neutral, 3e38))) == Cause.RETARGET


def test_templates_of_another_topology_are_bad_arguments(bundle: Bundle, tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="template: expected finite"):
        Converter(bundle, template=np.zeros((7, 3), np.float32))
    np.save(tmp_path / "t.npy", np.zeros((7, 3), np.float32))
    with pytest.raises(DataError, match="template"):
        Converter(bundle, template=tmp_path / "t.npy")


def test_codetalker_frames_one_at_a_time(shared: Path) -> None:
    """As they come from a socket: the expressions behind them, to 0.3 per cent of their spread."""
    from cap4d.rig.flame import import_flame

    folder = shared / "flame"
    flame = on_rig(import_flame(folder / "flame_standin.pkl", folder / "cap4d_assets"))
    truth = np.load(folder / "codetalker/truth.npz")
    vertices = (
        np.load(next((folder / "codetalker").glob("cond*.npy"))).reshape(-1, 5023, 3).astype(np.float32)
    )
    convert = Converter(flame, template=truth["template"].astype(np.float32))
    expr, residual = [], []
    for i, frame in enumerate(vertices):
        expr.append(convert(Packet(i / 30, vertices=frame)).expr)
        residual.append(convert.residual_mm)
    error, spread = np.sqrt(((np.array(expr) - truth["expr"]) ** 2).mean()), truth["expr"].std()
    print(f"expression error {error:.5f} rms of a spread of {spread:.3f}; residual {max(residual):.5f} mm")
    assert error < 0.003 * spread and max(residual) < 0.01
