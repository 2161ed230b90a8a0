"""Apple's shapes on FLAME: exact where the basis can show them, told where it cannot; jaws that open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")

from arkit_weights import arkit_weights
from drive_bundle import on_rig

from cap4d.bundle import Bundle
from cap4d.drive.arkit import COLUMN, NAMES, arkit_map
from cap4d.drive.arkit_flame import MAX_REST, Targets, own_targets, read_targets, write_targets
from cap4d.drive.convert import Converter
from cap4d.drive.fillers import lids_of
from cap4d.drive.packet import Packet
from cap4d.errors import DataError
from cap4d.rig.head import HeadRig

UPPER_LIP, LOWER_LIP = 3531, 3504  # vertices inside FLAME's lips


@pytest.fixture(scope="module")
def standin(shared: Path) -> HeadRig:
    from cap4d.rig.flame import import_flame

    return import_flame(shared / "flame/flame_standin.pkl", shared / "flame/cap4d_assets")


def offsets_on(rig: HeadRig) -> np.ndarray:
    """[52, V, 3] m of the shapes on the whole mesh, 0 where they are not known."""
    targets = own_targets()
    offsets = np.zeros((len(NAMES), len(rig.template), 3))
    offsets[:, targets.vertices] = targets.offsets
    return offsets


def learnt_basis(rig: HeadRig, offsets: np.ndarray) -> np.ndarray:
    """64 principal components of random faces, as FLAME's are learnt, then the rig's own blink."""
    mixes = np.random.default_rng(0).exponential(0.15, (400, len(NAMES)))
    faces = np.tensordot(mixes, offsets, 1).reshape(400, -1)
    _, spread, modes = np.linalg.svd(faces - faces.mean(0), full_matrices=False)
    components = (spread[:64, None] / 20 * modes[:64]).reshape(64, -1, 3)
    return np.concatenate([components, rig.expression_basis[64:]]).astype(np.float32)


@pytest.fixture(scope="module")
def no_jaw(standin: HeadRig) -> HeadRig:
    """FLAME's mesh with a basis that has seen faces, jaws and all. The stand-in's own moves both lips
    alike.
    """
    return replace(standin, expression_basis=learnt_basis(standin, offsets_on(standin)))


@pytest.fixture(scope="module")
def with_jaw(standin: HeadRig) -> HeadRig:
    """One whose jaw opens by its joint alone: skin weights like FLAME's, no expression that has seen it
    move.
    """
    offsets = offsets_on(standin)
    jaw = standin.joint_names.index("jaw")
    arms = np.linalg.norm((standin.template - standin.joints[jaw])[:, 1:], axis=1)
    skin = standin.skin_weights.copy()
    opening = np.linalg.norm(offsets[COLUMN["jawOpen"]], axis=1)
    skin[:, jaw] = np.clip(opening / arms / np.radians(24), 0, 1)
    still = offsets.copy()
    still[[COLUMN[name] for name in ("jawOpen", "jawLeft", "jawRight", "mouthClose")]] = 0
    basis = learnt_basis(standin, still)
    return replace(standin, name="flame2023", expression_basis=basis, skin_weights=skin, expr_rotation=None)


def opening(rig: HeadRig, bundle: Bundle, **values: float) -> float:
    """mm between the lips."""
    expr, _, jaw_rot = arkit_map(bundle)(arkit_weights(**values))
    vertices = rig.subject().pose(expr, jaw_rot=jaw_rot)
    return 1e3 * float(vertices[UPPER_LIP, 1] - vertices[LOWER_LIP, 1])


@pytest.fixture(scope="module")
def avatars(standin: HeadRig, no_jaw: HeadRig, with_jaw: HeadRig) -> dict[str, tuple[HeadRig, Bundle]]:
    rigs = {"standin": standin, "no_jaw": no_jaw, "with_jaw": with_jaw}
    return {name: (rig, on_rig(rig)) for name, rig in rigs.items()}


def test_the_table_is_small_symmetric_and_whole() -> None:
    targets = own_targets()
    assert 3000 < len(targets.vertices) < 3932 and targets.offsets.dtype == np.float32
    size = 1e3 * np.linalg.norm(targets.offsets, axis=-1).max(1)
    assert [NAMES[i] for i in np.flatnonzero(size == 0)] == ["tongueOut"]
    assert 35 < size[COLUMN["jawOpen"]] < 50 and 6 < size[COLUMN["eyeBlinkLeft"]] < 12
    for name in NAMES:
        if name.endswith("Left") and not name.startswith(("jaw", "mouthLeft")):
            assert np.isclose(size[COLUMN[name]], size[COLUMN[name[:-4] + "Right"]], rtol=0.1), name


def test_a_basis_that_has_seen_faces_shows_them(avatars: dict) -> None:
    """Seen at the grid of an avatar: a fifth of a millimetre of shapes of two to thirteen."""
    found = arkit_map(avatars["no_jaw"][1])
    assert found.missing == ("tongueOut",) and not found.jaw_rot.any()
    own = [i for i, name in enumerate(NAMES) if not name.startswith(("eye", "tongue"))]
    print(f"no_jaw, learnt: {found.error_mm[own].mean():.2f} mm, worst {found.error_mm[own].max():.2f} mm")
    assert found.error_mm[own].mean() < 0.25 and found.error_mm[own].max() < 0.5
    assert np.abs(found.expr).max() < 6, "within what FLAME's components reach"


def test_the_standins_errors_are_told(avatars: dict) -> None:
    """Its basis is synthetic: it moves both lips alike, so a jaw that opens is millimetres off, and says
    so.
    """
    found = arkit_map(avatars["standin"][1])
    by_name = dict(zip(NAMES, found.error_mm.tolist(), strict=True))
    print("stand-in:", ", ".join(f"{name} {mm:.1f}" for name, mm in by_name.items()), "mm")
    assert 3 < by_name["jawOpen"] < 6 and found.error_mm.mean() < 1.5
    assert not found.rest.any(), "what cannot close the lips is not asked to"


@pytest.mark.parametrize("edition", ["no_jaw", "with_jaw"])
def test_jaw_open_opens_the_mouth_and_nothing_closes_it(avatars: dict, edition: str) -> None:
    """The template's lips are 19 mm apart: Apple's neutral closes them."""
    rig, bundle = avatars[edition]
    shut, half, wide = (opening(rig, bundle, jawOpen=w) for w in (0, 0.5, 1))
    print(f"{edition}: lips {shut:.1f}, {half:.1f}, {wide:.1f} mm apart at jawOpen 0, 0.5, 1")
    assert abs(shut) < 5 and shut + 8 < half < wide - 8
    assert 0.3 < arkit_map(bundle).rest[COLUMN["jawOpen"]] < MAX_REST


def test_a_jaw_turns_where_there_is_one(avatars: dict) -> None:
    found = arkit_map(avatars["with_jaw"][1])
    degrees = np.degrees(found.jaw_rot)
    assert 15 < degrees[0, COLUMN["jawOpen"]] < 30 and np.abs(degrees[1:, COLUMN["jawOpen"]]).max() < 2
    assert degrees[1, COLUMN["jawLeft"]] > 1 and degrees[1, COLUMN["jawRight"]] < -1
    turned = [name for name, turn in zip(NAMES, degrees.T, strict=True) if turn.any()]
    assert turned == ["jawLeft", "jawRight", "jawOpen"]


def test_blinks_are_the_rigs_own(avatars: dict) -> None:
    for _, bundle in avatars.values():
        expr, _, _ = arkit_map(bundle)(arkit_weights(eyeBlinkLeft=1, eyeBlinkRight=1, jawOpen=0.2))
        assert np.isclose(expr[64] - arkit_map(bundle)(arkit_weights(jawOpen=0.2))[0][64], 1, atol=1e-5)


def test_without_a_blink_of_its_own_one_is_found_in_the_basis(standin: HeadRig) -> None:
    """FLAME's own 100 components, here as far as the learnt ones go."""
    offsets = offsets_on(standin)
    rig = replace(
        standin,
        expression_basis=learnt_basis(standin, offsets)[:64],
        expression_names=standin.expression_names[:64],
        expression_range=standin.expression_range[:64],
        joints_expression=standin.joints_expression[:64],
        expr_rotation=None,
    )
    bundle = on_rig(rig)
    lids = lids_of(bundle)
    moved = rig.subject().pose(lids.closed) - rig.subject().neutral
    wanted = offsets[COLUMN["eyeBlinkLeft"]] + offsets[COLUMN["eyeBlinkRight"]]
    at = np.linalg.norm(wanted, axis=1) > 0.003
    assert (
        np.linalg.norm((moved - wanted)[at], axis=1).mean() < 0.2 * np.linalg.norm(wanted[at], axis=1).mean()
    )
    assert np.allclose(lids.signal @ lids.closed, 1) and not lids.replaced.any()


def test_left_stays_left(avatars: dict) -> None:
    rig, bundle = avatars["no_jaw"]
    subject, found = rig.subject(), arkit_map(bundle)
    neutral = subject.pose(found(arkit_weights())[0])
    for name in ("mouthSmileLeft", "browDownLeft", "noseSneerLeft", "cheekSquintLeft"):
        moved = np.linalg.norm(subject.pose(found(arkit_weights(**{name: 1}))[0]) - neutral, axis=1)
        assert (moved * subject.neutral[:, 0]).sum() / moved.sum() > 0.01, name


def test_the_converter_rests_with_closed_lips(avatars: dict) -> None:
    rig, bundle = avatars["no_jaw"]
    convert = Converter(bundle)
    rest, driven = convert.neutral(), convert(Packet(0, arkit=arkit_weights()))
    assert np.array_equal(rest.expr, driven.expr) and rest.expr.any()
    vertices = rig.subject().pose(rest.expr)
    assert 1e3 * abs(vertices[UPPER_LIP, 1] - vertices[LOWER_LIP, 1]) < 5


def test_the_table_there_and_back(tmp_path: Path) -> None:
    offsets = np.random.default_rng(0).normal(0, 0.01, (52, 5, 3))
    offsets[3] = 0
    write_targets(tmp_path / "t.npz", Targets(np.arange(5), offsets, np.array([[1, 2]])))
    found = read_targets(tmp_path / "t.npz")
    assert np.abs(found.offsets - offsets).max() < np.abs(offsets).max() / 127 and not found.offsets[3].any()
    np.savez(tmp_path / "bad.npz", vertices=np.arange(5))
    with pytest.raises(DataError, match="offsets"):
        read_targets(tmp_path / "bad.npz")
