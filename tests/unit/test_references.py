"""Which images a fit is given: chosen, nested, never of a held-out camera."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tiny_avatar import tiny_rig

from cap4d.avatar.presets import preset_named
from cap4d.avatar.references import (
    choose_held_out,
    choose_references,
    read_references,
    select,
    split_selected,
    suited,
)
from cap4d.camera import Camera, look_at
from cap4d.capture.capture import Capture, save_capture
from cap4d.capture.image import write_image
from cap4d.errors import ArgumentError, DataError

FRAMES = 12
YAWS = {"left": -60, "centre": 2, "right": 40, "far": 55, "behind": 170}


def write_ring(path, *, held_out=None):
    """Five cameras about a head that turns and bulges; image values tell camera and frame."""
    K = np.array([[20.0, 0, 4], [0, 20.0, 4], [0, 0, 1]])
    cameras = {}
    for name, yaw in YAWS.items():
        away = np.array([np.sin(np.radians(yaw)), 0, -np.cos(np.radians(yaw))])
        cameras[name] = Camera(K, look_at(away, np.zeros(3)), 8, 8)
    rng = np.random.default_rng(0)
    expr = rng.uniform(0.2, 1, (FRAMES, 2))
    expr[7] = 0
    rot = np.zeros((FRAMES, 3))
    rot[:, 1] = rng.normal(0, 0.02, FRAMES)
    rot[7] = 0
    save_capture(
        path,
        rig_name="tiny",
        shape=np.zeros(1),
        expr=expr,
        rot=rot,
        tra=np.zeros((FRAMES, 3)),
        cameras=cameras,
        held_out=held_out,
    )
    for c, name in enumerate(cameras):
        (path / "images" / name).mkdir(parents=True)
        for t in range(FRAMES):
            write_image(path / "images" / name / f"{t:05d}.png", np.full((8, 8, 3), (20 * c + t) / 255))
    return Capture.load(path)


@pytest.fixture(scope="module")
def ring(tmp_path_factory):
    return write_ring(tmp_path_factory.mktemp("rings") / "ring")


def test_the_first_is_frontal_and_calm(ring):
    assert choose_references(ring, tiny_rig(), 1) == [("centre", 7)]


def test_fewer_are_the_first_of_more(ring):
    ten = choose_references(ring, tiny_rig(), 10)
    assert len(set(ten)) == 10
    for count in range(1, 10):
        assert choose_references(ring, tiny_rig(), count) == ten[:count]


def test_a_few_see_all_sides_and_many_faces(ring):
    five = choose_references(ring, tiny_rig(), 5)
    assert {"left", "centre", "behind"} <= {camera for camera, _ in five}
    assert len({frame for _, frame in five}) >= 4


def test_held_out_cameras_and_frames_are_left_alone(ring, tmp_path):
    marks = np.arange(FRAMES) >= 6
    marked = write_ring(tmp_path / "marked", held_out=marks)
    chosen = choose_references(marked, tiny_rig(), 4 * 6, hold_out=["left"])
    assert "left" not in {camera for camera, _ in chosen}
    assert max(frame for _, frame in chosen) == 5
    with pytest.raises(ArgumentError, match="references: expected 1 to 24, got 25"):
        choose_references(marked, tiny_rig(), 25, hold_out=["left"])


def test_another_seed_is_another_choice_and_repeats(ring):
    plain, other = (choose_references(ring, tiny_rig(), 8, seed=s) for s in (0, 3))
    assert plain != other
    assert other == choose_references(ring, tiny_rig(), 8, seed=3)


def test_held_out_cameras_are_frontal_and_spread(ring):
    assert choose_held_out(ring, 1) == ("right",)
    assert choose_held_out(ring, 2) == ("centre", "far")
    with pytest.raises(ArgumentError, match="fewer than the 4 in front, got 4"):
        choose_held_out(ring, 4)


def test_a_split_loads_only_what_was_selected(ring):
    references = [("behind", 3), ("centre", 7)]
    split = split_selected([ring], select(ring, references, ["left"]), 8)
    values = [round(255 * float(v.target.mean())) for v in split.train]
    assert values == [20 * 4 + 3, 20 * 1 + 7]
    assert [round(255 * float(v.target.mean())) for v in split.held_out] == list(range(FRAMES))


def test_without_held_out_cameras_the_rest_is_held_out(ring):
    split = split_selected([ring], select(ring, [("centre", 7)], []), 8)
    assert len(split.train) == 1
    assert len(split.held_out) == 24
    assert (20 + 7) not in [round(255 * float(v.target.mean())) for v in split.held_out]


def test_generated_captures_are_split_as_usual(ring, tmp_path):
    other = write_ring(tmp_path / "generated")
    split = split_selected([ring, other], select(ring, [("centre", 7)], ["left"]), 8)
    assert [v.capture for v in split.train] == [0] + [1] * (5 * (FRAMES - 1))
    assert {v.capture for v in split.held_out} == {0}


@pytest.mark.parametrize(
    ("references", "hold_out", "found"),
    [
        ([("nobody", 0)], [], "nobody"),
        ([("left", FRAMES)], [], str(FRAMES)),
        ([("left", 0)], ["left"], "left"),
        ([("left", 0), ("left", 0)], [], "distinct"),
        ([], [], "at least one"),
        (None, ["nobody"], "nobody"),
    ],
)
def test_a_wrong_selection_is_refused(ring, references, hold_out, found):
    with pytest.raises(ArgumentError, match=found):
        select(ring, references, hold_out)


def test_few_images_hold_hidden_gaussians_still():
    short, released = (preset_named("debug", recipe) for recipe in ("short", "released"))
    eps = [suited(short, count).rates.gaussian_eps for count in (1, 2, 10, 1000)]
    assert eps == pytest.approx([1e-5, 1.25e-6, 1e-8, 1e-8])
    assert replace(suited(short, 1), rates=short.rates) == short
    assert suited(released, 1) == released


def test_references_are_read_from_a_file(ring, tmp_path):
    path = tmp_path / "references.json"
    path.write_text(json.dumps([["left", 3], ["centre", 1]]))
    assert read_references(path, ring) == [("left", 3), ("centre", 1)]
    path.write_text(json.dumps([["left", True]]))
    with pytest.raises(DataError, match="entry 0"):
        read_references(path, ring)
    with pytest.raises(DataError, match="no file"):
        read_references(tmp_path / "absent.json", ring)
