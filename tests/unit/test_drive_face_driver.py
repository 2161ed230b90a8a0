"""A person other than the avatar: their resting face is learned, then their expressions drive."""

import numpy as np
import pytest
from synthetic_face import NAMES, SIZE, landmark_head, seen

from cap4d.drive.face_driver import GONE, MAX_BEND, FaceDriver
from cap4d.rotation import axis_angle_to_rotmat

FPS = 30


def person(seed: int = 0, amount: float = 0.004) -> np.ndarray:
    """[478, 3] m: how a face differs from the avatar's, smoothly."""
    rng = np.random.default_rng(seed)
    rest = landmark_head().subject.neutral.astype(float)
    waves = np.sin(rest @ rng.normal(0, 15, (3, 3)) + rng.uniform(0, 6, 3))
    return amount * waves


class Film:
    """Pictures that follow each other."""

    def __init__(self, **kind) -> None:
        self.driver, self.kind, self.t = FaceDriver(landmark_head()), kind, 0.0

    def show(self, expr=None, *, frames=1, **pose):
        for _ in range(frames):
            self.t += 1 / FPS
            packet = self.driver(seen(expr, **self.kind, **pose), SIZE, SIZE, self.t)
        return packet


def value(packet, name):
    return packet.expr[NAMES.index(name)]


def test_a_packet_is_the_rigs_own():
    packet = Film().show()
    assert packet.rig_name == "synthetic" and packet.expr.shape == (len(NAMES),)
    assert packet.arkit is None and packet.vertices is None and packet.t == 1 / FPS
    for array in (packet.expr, packet.eye_rot, packet.neck_rot, packet.rot, packet.tra):
        assert array.dtype == np.float32 and np.isfinite(array).all()


@pytest.mark.parametrize("seed", range(3))
def test_another_face_at_rest_is_at_rest_from_the_first_frame_on(seed):
    film = Film(identity=person(seed))
    assert np.abs(film.show().expr).max() < 0.15
    assert np.abs(film.show(frames=35).expr).max() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_another_faces_expressions_drive(seed):
    film = Film(identity=person(seed))
    film.show(frames=40)
    packet = film.show({"jawOpen": 0.8, "browInnerUp": 0.6}, frames=8)
    assert abs(value(packet, "jawOpen") - 0.8) < 0.12 and abs(value(packet, "browInnerUp") - 0.6) < 0.15
    assert np.abs(film.show(frames=12).expr).max() < 0.12


@pytest.mark.parametrize("lids", [0.6, 1.5])
def test_narrow_and_wide_eyes_shut_the_avatars_all_the_way(lids):
    film = Film(lids=lids)
    film.show(frames=40)
    shut = film.show({"eyeBlinkLeft": 0.8, "eyeBlinkRight": 0.8}, frames=2)
    assert min(value(shut, "eyeBlinkLeft"), value(shut, "eyeBlinkRight")) > 0.85
    assert np.abs(film.show(frames=4).expr[1:3]).max() < 0.1


def test_a_blink_and_a_word_in_the_first_second_are_not_rest():
    film = Film(identity=person())
    film.show(frames=5)
    film.show({"eyeBlinkLeft": 1, "eyeBlinkRight": 1}, frames=4)
    film.show({"jawOpen": 0.6}, frames=12)
    film.show(frames=12)
    assert np.abs(film.show(frames=5).expr).max() < 0.12
    assert value(film.show({"jawOpen": 0.6}, frames=6), "jawOpen") > 0.45


def test_who_comes_after_a_while_is_somebody_else():
    film = Film(identity=person(0))
    film.show(frames=40)
    film.kind = {"identity": person(1, 0.006)}
    film.t += GONE / 2
    stays = np.abs(film.show().expr).max()
    film.t += 2 * GONE
    assert np.abs(film.show(frames=3).expr).max() < min(0.15, stays)


def test_the_avatars_own_person_keeps_the_expression_at_rest():
    film = Film()
    assert value(film.show({"browInnerUp": 0.5}, frames=40), "browInnerUp") > 0.4


def test_the_neck_turns_against_the_head():
    film = Film()
    film.show(frames=40)
    packet = film.show(rot=(0, 0.3, 0), frames=10)
    shoulders = axis_angle_to_rotmat(packet.rot.astype(float)) @ axis_angle_to_rotmat(
        packet.neck_rot.astype(float)
    )
    np.testing.assert_allclose(shoulders, np.eye(3), atol=0.06)
    for turn in np.linspace(0.3, 0.9, 10):
        packet = film.show(rot=(0, turn, 0))
    assert np.linalg.norm(packet.neck_rot) < MAX_BEND + 1e-3


def test_no_face_is_no_packet_and_no_harm():
    film = Film()
    film.show(frames=40)
    before = film.show({"jawOpen": 0.5}, frames=5).expr
    for junk in (np.full((478, 2), np.nan), np.zeros((478, 2)), np.zeros((3, 2))):
        assert film.driver(junk, SIZE, SIZE, film.t) is None
    np.testing.assert_allclose(film.show({"jawOpen": 0.5}).expr, before, atol=0.03)


def test_hostile_landmarks_never_raise_nor_come_through():
    rng, film = np.random.default_rng(4), Film()
    for i in range(60):
        points = seen() if i % 3 == 0 else rng.normal(SIZE / 2, 10 ** rng.uniform(-2, 4), (478, 2))
        if i % 5 == 4:
            points = seen() + rng.normal(0, 30, (478, 2))
        film.t += 1 / FPS
        packet = film.driver(points, SIZE, SIZE, film.t)
        if packet is not None:
            arrays = (packet.expr, packet.eye_rot, packet.neck_rot, packet.rot, packet.tra)
            assert all(np.isfinite(array).all() for array in arrays)
    assert film.show(frames=5) is not None
