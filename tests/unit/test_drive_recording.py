"""A file as packets: in its own terms, or through an avatar in others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cap4d.drive.arkit import NAMES
from cap4d.drive.livelink import ANGLES, parse_livelink
from cap4d.drive.livelink_format import format_livelink
from cap4d.drive.recording import arkit_from_expr, open_recording, posed_recording
from cap4d.drive.vertices import VERTEX_FPS
from cap4d.errors import ArgumentError, DataError

T, E = 6, 4


@pytest.fixture
def fit(tmp_path: Path) -> str:
    rng = np.random.default_rng(0)
    path = tmp_path / "fit.npz"
    turns = {name: 0.1 * rng.normal(size=(T, 3)) for name in ("eye_rot", "rot", "tra")}
    np.savez(path, expr=rng.normal(size=(T, E)), fps=25, neck_rot=np.zeros((T, 3)), rig_name="any", **turns)
    return str(path)


def test_a_fit_is_sent_in_its_own_rigs_terms(fit):
    recording = open_recording(fit)
    arrays = np.load(fit)
    assert (recording.form, recording.fps, recording.count) == ("expr", 25.0, T)
    packet = recording.packet(2, 7.5)
    assert (packet.t, packet.rig_name) == (7.5, "any")
    np.testing.assert_array_equal(packet.expr, np.float32(arrays["expr"][2]))
    np.testing.assert_array_equal(packet.eye_rot, np.float32(arrays["eye_rot"][2]))
    np.testing.assert_array_equal(packet.tra, np.float32(arrays["tra"][2]))


def test_rotations_that_the_source_does_not_know_are_left_out(fit):
    packet = open_recording(fit).packet(0, 0.0)
    assert packet.neck_rot is None  # zero throughout
    assert packet.jaw_rot is None  # not in the file
    assert packet.arkit is packet.vertices is None


def test_vertices_are_sent_as_they_are_whatever_their_number(tmp_path):
    vertices = np.random.default_rng(0).normal(size=(T, 7, 3)).astype(np.float32)
    np.save(tmp_path / "v.npy", vertices.reshape(T, 21))
    recording = open_recording(str(tmp_path / "v.npy"))
    assert (recording.form, recording.fps, recording.count) == ("vertices", VERTEX_FPS, T)
    np.testing.assert_array_equal(recording.packet(3, 0.0).vertices, vertices[3])
    assert open_recording(str(tmp_path / "v.npy"), fps=60).fps == 60


def test_a_ragged_array_of_vertices_is_refused(tmp_path):
    np.save(tmp_path / "v.npy", np.zeros((T, 20), np.float32))
    with pytest.raises(DataError, match="vertices"):
        open_recording(str(tmp_path / "v.npy"))


def test_a_live_link_recording_is_sent_as_it_is(tmp_path):
    rng, names = np.random.default_rng(0), (*NAMES, *ANGLES)
    values = rng.random((5, len(names))).astype(np.float32)
    rows = [f"10:00:00:{i:02d}.0,61," + ",".join(map(str, row)) for i, row in enumerate(values)]
    path = tmp_path / "face.csv"
    path.write_text("\n".join([f"Timecode,BlendShapeCount,{','.join(names)}", *rows]) + "\n")
    recording = open_recording(str(path), fps=60)
    assert (recording.form, recording.fps, recording.count) == ("arkit", 60.0, 5)
    packet = recording.packet(2, 0.5)
    np.testing.assert_allclose(packet.arkit, values[2, :52], atol=1e-6)
    assert packet.eye_rot is not None and packet.rot is not None
    again = parse_livelink(format_livelink(packet))  # over the wire that it came from
    np.testing.assert_allclose(again.rot, packet.rot, atol=1e-6)


def test_arkit_weights_are_their_namesakes_or_the_mean_of_two_sides():
    names = tuple(n.replace("Left", "_L").replace("Right", "_R") for n in NAMES if n != "browInnerUp")
    names += ("browInnerUp_L", "browInnerUp_R")
    expr = np.random.default_rng(0).random(len(names)).astype(np.float32)
    weights = dict(zip(NAMES, expr @ arkit_from_expr(names), strict=True))
    assert weights["eyeBlinkLeft"] == expr[names.index("eyeBlink_L")]
    assert weights["browInnerUp"] == pytest.approx(expr[-2:].mean())
    assert weights["jawOpen"] == expr[names.index("jawOpen")]


def test_a_rig_without_arkits_names_has_no_such_weights():
    with pytest.raises(ArgumentError, match="ARKit's 52 names, got one with 0"):
        arkit_from_expr(("expr00", "expr01"))


class TestThroughAnAvatar:
    """With the tiny avatar, whose writer needs the onnx package."""

    @pytest.fixture
    def avatar(self, tmp_path) -> Path:
        pytest.importorskip("onnx")
        from tiny_bundle import tiny_bundle

        from cap4d.bundle.writer import write_bundle

        path = tmp_path / "tiny.cap4d"
        write_bundle(tiny_bundle(network=False), path)
        return path

    def test_an_avatar_sends_its_idle_clip(self, avatar):
        recording = open_recording(str(avatar))
        assert (recording.form, recording.fps, recording.count) == ("expr", 24.0, 12)
        assert recording.packet(0, 0.0).rig_name == "tiny"

    def test_expressions_become_the_avatars_own_mesh_and_back(self, avatar, tmp_path):
        from tiny_bundle import tiny_bundle

        bundle = tiny_bundle(network=False)
        posed = posed_recording(bundle.idle, bundle)
        assert posed.form == "vertices"
        np.save(tmp_path / "v.npy", np.stack([posed.packet(i, 0.0).vertices for i in range(posed.count)]))
        np.save(tmp_path / "neutral.npy", bundle.mesh_subject.pose(np.zeros(5, np.float32)))
        back = open_recording(
            str(tmp_path / "v.npy"), form="expr", avatar=avatar, template=tmp_path / "neutral.npy"
        )
        assert back.form == "expr"
        for i in range(posed.count):
            assert np.abs(back.packet(i, 0.0).expr - bundle.idle.expr[i]).max() < 0.2
        assert posed.packet(5, 0.0).neck_rot is not None  # which the mesh does not show

    def test_an_avatar_without_its_mesh_has_no_vertices_to_send(self, avatar):
        with pytest.raises(ArgumentError, match="holds its rig's mesh"):
            open_recording(str(avatar), form="vertices")

    def test_a_rig_of_other_names_has_no_arkit_weights(self, avatar):
        with pytest.raises(ArgumentError, match="ARKit"):
            open_recording(str(avatar), form="arkit")


@pytest.mark.parametrize(
    ("spec", "options", "words"),
    [
        ("film.mp4", {}, "drive: expected a fit.npz"),
        ("fit.npz", {"form": "vertices"}, "as: fit.npz holds expr"),
        ("fit.npz", {"template": Path("a.npy")}, "template"),
    ],
)
def test_what_makes_no_sense_is_refused(spec, options, words):
    with pytest.raises(ArgumentError, match=words):
        open_recording(spec, **options)


def test_a_missing_file_is_named():
    with pytest.raises(DataError, match=r"nowhere\.npz"):
        open_recording("nowhere.npz")
