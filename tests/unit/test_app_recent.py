"""Recent files: kept, in order, whatever the file that keeps them has become."""

import json
import os

import pytest
from cap4d.app.recent import KEPT, MAX_BYTES, RecentFiles, config_folder


@pytest.fixture
def path(tmp_path):
    return tmp_path / "config" / "recent.json"


def test_they_are_remembered_newest_first_without_doubles(path, tmp_path):
    recent = RecentFiles(path)
    for name in ("a", "b", "a"):
        recent.add(tmp_path / name)
    assert RecentFiles(path).files == recent.files == [tmp_path / "a", tmp_path / "b"]


def test_paths_become_absolute(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    recent = RecentFiles(path)
    recent.add(type(path)("here.cap4d"))
    assert recent.files == [tmp_path / "here.cap4d"]


def test_old_ones_are_forgotten(path, tmp_path):
    recent = RecentFiles(path)
    for i in range(KEPT + 5):
        recent.add(tmp_path / str(i))
    assert len(RecentFiles(path).files) == KEPT
    recent.forget(recent.files[0])
    assert RecentFiles(path).files[0] == tmp_path / str(KEPT + 3)
    recent.clear()
    assert RecentFiles(path).files == []


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b'{"a": 1}',
        b"\xff\xfe",
        b"[" * 50_000,
        b"[1, null, [], {}]",
        b'["' + b"x" * MAX_BYTES + b'"]',
        json.dumps(["", "a\x00b", "a\nb", "x" * 5000, 3]).encode(),
    ],
)
def test_a_broken_or_hostile_file_is_an_empty_list(path, content):
    path.parent.mkdir()
    path.write_bytes(content)
    assert RecentFiles(path).files == []


def test_a_folder_or_a_pipe_in_its_place_is_an_empty_list(path):
    path.mkdir(parents=True)
    assert RecentFiles(path).files == []
    pipe = path.with_name("pipe.json")
    if hasattr(os, "mkfifo"):
        os.mkfifo(pipe)
        assert RecentFiles(pipe).files == []


def test_a_list_that_cannot_be_written_costs_nothing_else(path, caplog):
    path.mkdir(parents=True)
    recent = RecentFiles(path)
    recent.add(path / "a")
    assert recent.files == [path / "a"]
    assert "recent files are not kept" in caplog.text


def test_the_users_own_folder(monkeypatch, tmp_path):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert config_folder() == tmp_path / "cap4d"
