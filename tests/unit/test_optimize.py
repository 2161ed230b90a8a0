"""The steps of `cap4d optimize`, each on a tiny avatar."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnx")

from quantized_reference import random_network
from tiny_bundle import RIG_NAME, tiny_bundle, tiny_mesh

from cap4d.avatar.views import held_out_frames
from cap4d.bundle import Bundle, read_bundle
from cap4d.bundle.schema import MANIFEST
from cap4d.capture.capture import Capture, View
from cap4d.errors import ArgumentError
from cap4d.optimize.candidate import Candidate, with_gaussians
from cap4d.optimize.degree import at_degree
from cap4d.optimize.form import smallest_forms, sparser_bases
from cap4d.optimize.judge import Judge
from cap4d.optimize.limit import parse_decibels, parse_size
from cap4d.optimize.measure import measure
from cap4d.optimize.prune import prune
from cap4d.optimize.refine import refined
from cap4d.optimize.removal import blending_weights, removal_errors
from cap4d.optimize.scene import full_pictures
from cap4d.optimize.shots import choose_shots
from cap4d.optimize.tier import cheapest_tier, with_cheaper_tiers
from cap4d.optimize.unused import without_unused
from cap4d.player.avatar import Avatar


def small(**options) -> Bundle:
    bundle = tiny_bundle(8, gaussians=2, mesh=False, **options)
    # Smaller than a face and not opaque, so that no Gaussian reaches the clamp of alpha.
    return replace(bundle, opacity_logits=np.minimum(bundle.opacity_logits, 2))


@pytest.fixture(scope="module")
def full() -> Candidate:
    return Candidate(small(), "full", {})


@pytest.fixture(scope="module")
def judge(full: Candidate) -> Judge:
    return Judge(full.bundle)


def pooled(db: float) -> float:
    return 10 ** (-db / 10)


def test_the_full_avatar_is_as_near_to_float64_as_float32_is(full: Candidate, judge: Judge) -> None:
    assert judge.error(full).psnr > 85 and judge.error(full).worst > 80
    assert judge.error_beyond(full).pooled == 0  # drawn by the same player


def test_no_shot_is_both_learned_from_and_measured(full: Candidate) -> None:
    shots = choose_shots(Avatar(replace(full.bundle, idle=long_clip(full.bundle)), deformer="off"))
    learned, measured = (
        {(s.frame.t, s.camera.viewmat.tobytes()) for s in x} for x in (shots.learned, shots.measured)
    )
    assert len(shots.measured) == 16 and len(shots.learned) == 24 and not learned & measured
    assert (
        len({s.camera.viewmat.tobytes() for s in shots.measured}) == 9
    )  # the default one and eight around it


def a_capture(bundle: Bundle, *, rig_name: str = RIG_NAME) -> Capture:
    """A film of the idle clip, in memory; the head's pose is in the camera."""
    clip = long_clip(bundle)
    count, zeros = len(clip), np.zeros((len(clip), 3), np.float32)
    poses = {"rot": zeros, "tra": zeros, "eye_rot": clip.eye_rot, "neck_rot": clip.neck_rot, "jaw_rot": zeros}
    return Capture(
        path=Path("capture"),
        rig_name=rig_name,
        shape=np.zeros(1, np.float32),
        expr=clip.expr,
        **poses,
        cameras={"cam": bundle.camera.resized(1024, 1024)},
        fps=24.0,
        views=tuple(View("cam", t, Path(f"{t}.png"), None) for t in range(count)),
    )


def test_training_views_of_a_capture_are_looked_at_too(full: Candidate) -> None:
    avatar, capture = Avatar(full.bundle, deformer="off"), a_capture(full.bundle)
    shots = choose_shots(avatar, capture)
    assert (len(shots.learned), len(shots.measured)) == (48, 32)
    seen = {round(s.frame.t * capture.fps) for s in (*shots.learned[24:], *shots.measured[16:])}
    assert not seen & set(np.flatnonzero(held_out_frames(capture)).tolist())
    assert {s.camera.width for s in shots.measured[16:]} == {512}
    with pytest.raises(ArgumentError, match="rig: expected"):
        choose_shots(avatar, a_capture(full.bundle, rig_name="other"))


def long_clip(bundle: Bundle):
    """The idle clip, eight times over."""
    names = ("expr", "eye_rot", "neck_rot", "jaw_rot")
    return replace(bundle.idle, **{n: np.tile(getattr(bundle.idle, n), (8, 1)) for n in names})


def test_the_stored_candidate_is_what_comes_back_from_its_file(full: Candidate, tmp_path) -> None:
    forms = {"sh": "int8", "means": "float16", "expression_basis": "int8", "quats": "float16"}
    candidate = Candidate(with_cheaper(full.bundle), "linear", forms | {"deform_linear": "int8"})
    candidate.write(tmp_path / "a.cap4d")
    back, stored = read_bundle(tmp_path / "a.cap4d"), candidate.stored()
    assert (tmp_path / "a.cap4d").stat().st_size == candidate.size()
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh", "deform_linear"):
        assert np.array_equal(getattr(back, name), getattr(stored, name)), name
    assert np.array_equal(back.subject.expression_basis, stored.subject.expression_basis)
    assert (back.deform_onnx, back.deform_int8) == (None, None) and back.tiers == ("linear", "off")


def test_a_head_on_its_mesh_is_changed_there(tmp_path: Path) -> None:
    """As FLAME's, whose mesh has fewer points than the grid."""
    bundle, mesh = small(network=False), tiny_mesh(6)
    vertices = np.random.default_rng(1).integers(36, size=bundle.grid.vertices.shape).astype(np.int32)
    grid = replace(bundle.grid, vertices=vertices)
    subject = mesh.resample(grid.vertices, grid.bary)
    bundle = replace(bundle, grid=grid, subject=subject, mesh_subject=mesh, rig_vertices=0)
    candidate = Candidate(
        without_unused(bundle), "off", {"expression_basis": "int8", "pose_basis": "float16"}
    )
    candidate.write(tmp_path / "a.cap4d")
    back, stored = read_bundle(tmp_path / "a.cap4d"), candidate.stored()
    assert len(back.mesh_subject.neutral) == 36 and back.subject.pose_offset is None
    for name in ("neutral", "expression_basis", "pose_basis"):
        assert np.array_equal(getattr(back.subject, name), getattr(stored.subject, name)), name


def with_cheaper(bundle: Bundle) -> Bundle:
    """With a line per expression that is nearly right, and a whole-number network that is not."""
    bundle = replace(with_cheaper_tiers(bundle), deform_int8=random_network(8, 1))
    assert bundle.deform_linear is not None
    return bundle


def test_the_removal_error_is_the_error_of_removing(full: Candidate, judge: Judge) -> None:
    """Its mean over many draws of signs, against removing one Gaussian after the other."""
    scene = judge.scene(full)
    draws = np.mean([removal_errors(full.bundle, scene, seed=i) for i in range(8)], 0)
    rng, found, expected = np.random.default_rng(0), [], []
    for i in rng.choice(np.flatnonzero(draws > np.median(draws)), 12, replace=False):
        without = with_gaussians(full.bundle, np.arange(len(full.bundle)) != i)
        expected.append(measure(Avatar(without), judge.shots.learned, judge._learned).pooled)
        found.append(draws[i])
    assert np.corrcoef(np.log(found), np.log(expected))[0, 1] > 0.98
    assert np.abs(np.log(np.array(found) / expected)).mean() < 0.15


def test_what_no_shot_shows_costs_nothing(full: Candidate, judge: Judge) -> None:
    hidden = full.bundle.opacity_logits.copy()
    hidden[5] = -20
    bundle = replace(full.bundle, opacity_logits=hidden)
    assert removal_errors(bundle, judge.scene(full), seed=0)[5] == 0
    assert not blending_weights(bundle, judge.scene(full))[:, 5].any()


def test_shares_of_pixels_add_up_to_their_coverage(full: Candidate, judge: Judge) -> None:
    weights = blending_weights(full.bundle, judge.scene(full))
    coverage = [picture.alpha.sum() for picture in judge._learned]
    np.testing.assert_allclose(weights.sum(1), coverage, rtol=0.02)


def test_a_lower_degree_that_shows_the_same_is_found() -> None:
    """Harmonics whose higher bands are zero lose nothing; others lose less than by truncation."""
    bundle = small(sh_degree=2)
    judge = Judge(bundle)
    flat = bundle.sh.copy()
    flat[:, 4:] = 0
    scene = judge.scene(Candidate(bundle, "full", {}))
    same = at_degree(replace(bundle, sh=flat), scene, 1)
    np.testing.assert_allclose(same.sh, flat[:, :4], atol=1e-5)
    fitted = Candidate(at_degree(bundle, scene, 1), "full", {})
    cut = Candidate(replace(bundle, sh=np.ascontiguousarray(bundle.sh[:, :4])), "full", {})
    assert judge.error(fitted).psnr > judge.error(cut).psnr + 0.5


def test_unused_parts_go_and_pictures_stay(full: Candidate, judge: Judge) -> None:
    faint = full.bundle.opacity_logits.copy()
    faint[full.bundle.binding < 4] = -20
    bundle = replace(full.bundle, opacity_logits=faint)
    lean = without_unused(bundle)
    assert len(lean) == len(bundle) - 8 and len(lean.grid.faces) == len(bundle.grid.faces) - 4
    assert lean.subject.pose_offset is None and lean.subject.pose_basis is not None
    drawn = full_pictures(Avatar(bundle), judge.shots.measured)
    assert measure(Avatar(lean), judge.shots.measured, drawn).psnr > 95


def test_forms_shrink_the_file_within_their_share(full: Candidate, judge: Judge) -> None:
    found = smallest_forms(full, judge, pooled(50), share=0.05)
    assert found.size() < 0.8 * full.size() and judge.error(found).psnr > 50
    assert set(found.forms.values()) <= {"float16", "int8"} and "int8" in found.forms.values()
    strict = smallest_forms(full, judge, pooled(80), share=0.05)
    assert strict.size() > found.size() and strict.forms.get("sh") != "int8"
    assert judge.error(strict).psnr > 80


def test_bases_lose_what_barely_moves() -> None:
    bundle = small()
    before = bundle.subject.expression_basis.copy()
    before[:, ::2] *= np.float32(2e-3)  # some micrometres
    full = Candidate(replace(bundle, subject=replace(bundle.subject, expression_basis=before)), "full", {})
    judge = Judge(full.bundle)
    found = sparser_bases(full, judge, pooled(60), share=0.5)
    after = found.bundle.subject.expression_basis
    gone = ~after.any(-1)
    assert gone.mean() > 0.45 and np.array_equal(before[~gone], after[~gone])
    assert np.abs(before[gone]).max() < 2e-4
    assert judge.error(found).psnr > 60 and found.size() < full.size()


def test_the_cheapest_deformer_within_the_limit_plays(full: Candidate, judge: Judge) -> None:
    """Lines are nearly right on this network, the whole-number one is made of chance, none is far off."""
    candidate = replace(full, bundle=with_cheaper(full.bundle))
    errors = {t: judge.error(replace(candidate, tier=t)).pooled for t in ("full", "int8", "linear", "off")}
    assert errors["full"] < errors["linear"] < errors["off"] < errors["int8"]
    assert cheapest_tier(candidate, judge, 1.01 * errors["off"]).tier == "off"
    assert cheapest_tier(candidate, judge, 1.01 * errors["linear"]).tier == "linear"
    halved = cheapest_tier(candidate, judge, 0.9 * errors["linear"])
    assert halved.tier == "fp16" and len(halved.bundle.deform_onnx) < len(candidate.bundle.deform_onnx)
    assert cheapest_tier(candidate, judge, errors["full"] / 2).tier == "full"


def test_refining_brings_a_pruned_avatar_nearer(full: Candidate, judge: Judge) -> None:
    scene = judge.scene(full)
    order = np.argsort(removal_errors(full.bundle, scene, seed=0))
    pruned = replace(full, bundle=with_gaussians(full.bundle, np.sort(order[len(order) // 3 :])))
    better = replace(full, bundle=refined(pruned.bundle, scene, steps=48))
    assert judge.error(better).psnr > judge.error(pruned).psnr + 1


def test_pruning_keeps_the_limit_and_goes_near_it(full: Candidate, judge: Judge) -> None:
    pruned = prune(full, judge, pooled(40))
    assert 40 <= judge.error(pruned).psnr < 44
    assert len(pruned.bundle) < 0.95 * len(full.bundle)
    assert len(np.unique(pruned.bundle.binding)) == len(pruned.bundle.grid.faces)
    assert len(prune(full, judge, pooled(99)).bundle) == len(full.bundle)


def test_pruning_ends_when_it_is_enough(full: Candidate, judge: Judge) -> None:
    size = full.size() - 2000
    found = prune(full, judge, pooled(20), enough=lambda c: c.size() <= size)
    assert 0.9 * size < found.size() <= size


def test_the_entries_of_a_candidate_are_those_of_its_deformer(full: Candidate) -> None:
    bundle = with_cheaper(full.bundle)
    assert "deform.onnx" in Candidate(bundle, "full", {}).entries()
    off = Candidate(bundle, "off", {}).entries()
    assert MANIFEST in off and not [name for name in off if "deform" in name]


@pytest.mark.parametrize(("text", "db"), [("45dB", 45), ("45", 45), (" 38.5 db ", 38.5)])
def test_decibels(text: str, db: float) -> None:
    assert parse_decibels(text) == db


@pytest.mark.parametrize(
    ("text", "size"), [("20MB", 20_000_000), ("1.5kB", 1500), ("2MiB", 2 << 20), ("7", 7)]
)
def test_sizes(text: str, size: int) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "dB", "0dB", "-3dB", "200dB", "45MB", "nan", "1e3"])
def test_what_is_no_number_of_decibels(text: str) -> None:
    with pytest.raises(ArgumentError, match="max-error"):
        parse_decibels(text)


@pytest.mark.parametrize("text", ["", "MB", "0", "-1MB", "20dB", "0.1B", "nan"])
def test_what_is_no_size(text: str) -> None:
    with pytest.raises(ArgumentError, match="max-size"):
        parse_size(text)
