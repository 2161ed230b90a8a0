"""Cross-reenactment: which frames, what is kept, what is said; the estimators themselves are tested apart."""

import json
import re

import numpy as np
import pytest
from tiny_avatar import tiny_rig
from tiny_bundle import tiny_bundle
from tiny_ring import write_tiny_ring

from cap4d.bundle import write_bundle
from cap4d.capture.capture import Capture
from cap4d.capture.image import write_image
from cap4d.errors import ArgumentError, DataError
from cap4d.evaluate.protocols import cross_reenactment as module
from cap4d.evaluate.protocols.cross_reenactment import Cross, cross_reenactment, driven_views, identity

CROSS = Cross(frames=2, size=32)


@pytest.fixture
def people(tmp_path):
    """Two avatars of one name in folders of their own, and a driver."""
    avatars = []
    for name in ("ann", "bob"):
        (tmp_path / name).mkdir()
        avatars.append(tmp_path / name / "avatar.cap4d")
        write_bundle(tiny_bundle(network=False), avatars[-1])
    write_tiny_ring(tmp_path / "carl")
    return avatars, tmp_path / "carl"


@pytest.fixture
def measured(monkeypatch):
    """Stands in for the estimators; notes what they were asked."""
    asked = []

    def measure(avatar, driver, views, cross, pictures):
        asked.append(avatar.parent.name)
        for camera, frame in views:
            (pictures / camera).mkdir(parents=True, exist_ok=True)
            write_image(pictures / camera / f"{frame:05d}.png", np.full((32, 32, 3), 0.5))
        return {"gaze": np.array([1.0 + len(asked)] + [np.nan] * (len(views) - 1))}, {"CSIM": "a network"}

    monkeypatch.setattr(module, "measure", measure)
    return asked


def test_the_most_frontal_camera_drives(people):
    capture = Capture.load(people[1])
    assert driven_views(capture, 2) == (("cam2", 0), ("cam2", 3))
    assert len(driven_views(capture, 100)) == 4
    assert tiny_rig().name == capture.rig_name


def test_every_avatar_is_driven_by_everybody(people, measured, tmp_path):
    avatars, driver = people
    results = cross_reenactment(avatars, [driver], tmp_path / "cross", CROSS)
    assert [(r.avatar, r.driver, r.mean("gaze")) for r in results] == [("ann", "carl", 2), ("bob", "carl", 3)]
    text = (tmp_path / "cross" / "table.md").read_text()
    assert "| ann | carl | 2.00 | 2 |" in text
    assert "- CSIM: not measured: needs a network" in text
    report = json.loads((tmp_path / "cross" / "report.json").read_text())
    assert report["cells"][0]["values"]["gaze"] == [2.0, None]
    assert (tmp_path / "cross" / "page.png").stat().st_size > 1000
    page = (tmp_path / "cross" / "page.html").read_text()
    assert "<title>Cross-reenactment</title>" in page
    sources = re.findall(r"src='([^']+)'", page)
    assert len(sources) == 2 * 3 and all((tmp_path / "cross" / source).is_file() for source in sources)


def test_what_is_finished_is_kept(people, measured, tmp_path):
    avatars, driver = people
    cross_reenactment(avatars[:1], [driver], tmp_path / "cross", CROSS)
    cross_reenactment(avatars[:1], [driver], tmp_path / "cross", CROSS)
    assert measured == ["ann"]
    cross_reenactment(avatars[:1], [driver], tmp_path / "cross", Cross(frames=3, size=32))
    assert measured == ["ann", "ann"]


def test_one_that_fails_does_not_lose_the_others(people, measured, tmp_path, monkeypatch):
    avatars, driver = people
    avatars[0].write_bytes(b"")
    stub = module.measure

    def fails(avatar, *rest):
        if not avatar.stat().st_size:
            raise DataError(avatar, "file", expected="an avatar", found="nothing")
        return stub(avatar, *rest)

    monkeypatch.setattr(module, "measure", fails)
    with pytest.raises(DataError, match=r"ann driven by carl.*expected an avatar"):
        cross_reenactment(avatars, [driver], tmp_path / "cross", CROSS)
    assert "| bob | carl |" in (tmp_path / "cross" / "table.md").read_text()


def test_names_must_differ(people, tmp_path):
    with pytest.raises(ArgumentError, match="drivers: expected different names, got carl, carl"):
        cross_reenactment(people[0], [people[1], people[1]], tmp_path / "cross", CROSS)


def test_identity_is_of_the_resting_face(people, tmp_path):
    class Metric:
        def measure(self, pair):
            assert pair.image.shape == pair.truth.shape
            return float(np.abs(pair.image[:8, :8] - 0.25).max() < 0.01)

    write_image(tmp_path / "a.png", np.full((32, 32, 3), 0.25))
    write_image(tmp_path / "b.png", np.full((32, 32, 3), 0.75))
    found = identity(people[0][0], [tmp_path / "a.png", tmp_path / "b.png"], Metric())
    assert found.tolist() == [1, 0]
