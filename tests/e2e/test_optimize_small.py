"""`cap4d optimize` on a small avatar, as a user meets it."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("onnx")

from tiny_bundle import tiny_bundle, tiny_bundle_on_mesh

from cap4d import Avatar
from cap4d.bundle import read_bundle, read_manifest, write_bundle
from cap4d.cli import main
from cap4d.optimize.candidate import Candidate
from cap4d.optimize.judge import Judge


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("optimize") / "avatar.cap4d"
    write_bundle(tiny_bundle(8, gaussians=4, sh_degree=1), path)
    return path


def test_it_gets_smaller_within_the_limit(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    before = path.read_bytes()
    small, again = tmp_path / "small.cap4d", tmp_path / "again.cap4d"
    for output in (small, again):
        assert main(["optimize", str(path), "--max-error", "40dB", "-o", str(output)]) == 0
    assert path.read_bytes() == before
    assert small.read_bytes() == again.read_bytes()
    assert small.stat().st_size < len(before) / 2
    found = read_bundle(small)
    assert len(found) < len(read_bundle(path)) and read_manifest(small).version == 2
    # Measured anew from the file: the limit holds, and was used.
    judge = Judge(read_bundle(path))
    assert 40 <= judge.error(Candidate(found, found.tiers[0], {})).psnr < 46
    image = Avatar.load(small).render(found.idle.expr[0])
    assert image.shape == (64, 64, 4)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("step") and lines[1].startswith("full avatar")
    assert f"{small.stat().st_size:,}" in lines[-2] and "times smaller" in lines[-1]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["again.cap4d", "small.cap4d"]


def test_a_size_is_met_at_the_least_error(path: Path, tmp_path: Path) -> None:
    whole = path.stat().st_size
    for part in (0.7, 0.4):
        small = tmp_path / "small.cap4d"
        assert main(["optimize", str(path), "--max-size", f"{part * whole:.0f}", "-o", str(small)]) == 0
        assert small.stat().st_size <= part * whole


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "expected one of --max-error and --max-size"),
        (["--max-error", "45dB", "--max-size", "1MB"], "expected one of"),
        (["--max-error", "much"], "max-error: expected"),
        (["--max-size", "20dB"], "max-size: expected"),
        (["--max-size", "1kB"], "max-size: expected at least"),
    ],
)
def test_bad_arguments_are_one_line(
    arguments: list[str], message: str, path: Path, tmp_path: Path, capfd: pytest.CaptureFixture
) -> None:
    assert main(["optimize", str(path), *arguments, "-o", str(tmp_path / "a.cap4d")]) == 2
    lines = capfd.readouterr().err.strip().splitlines()
    assert message in lines[-1] and len([line for line in lines if line.startswith("cap4d:")]) == 1
    assert not list(tmp_path.iterdir())


def test_the_avatar_itself_is_never_the_output(path: Path, capfd: pytest.CaptureFixture) -> None:
    before = path.read_bytes()
    assert main(["optimize", str(path), "--max-error", "45dB", "-o", str(path)]) == 2
    assert "another file" in capfd.readouterr().err and path.read_bytes() == before


def test_a_capture_of_another_rig_or_none_is_refused(path: Path, tmp_path: Path, capfd) -> None:
    arguments = ["optimize", str(path), "--max-error", "45dB", "--capture", str(tmp_path / "none")]
    assert main([*arguments, "-o", str(tmp_path / "a.cap4d")]) == 1
    assert "fit.npz" in capfd.readouterr().err and not list(tmp_path.iterdir())


def test_interrupting_leaves_nothing(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    kept = tmp_path / "kept.cap4d"
    kept.write_bytes(b"before")
    monkeypatch.setattr("cap4d.optimize.optimize.prune", interrupt)
    for output in (kept, tmp_path / "new.cap4d"):
        assert main(["optimize", str(path), "--max-error", "40dB", "-o", str(output)]) == 130
    assert [p.name for p in tmp_path.iterdir()] == ["kept.cap4d"] and kept.read_bytes() == b"before"


def test_an_avatar_on_the_rigs_own_triangles_is_made_smaller(tmp_path: Path) -> None:
    source, output = tmp_path / "a.cap4d", tmp_path / "b.cap4d"
    write_bundle(tiny_bundle_on_mesh(8, gaussians=2), source)
    assert main(["optimize", str(source), "--max-error", "35dB", "-o", str(output)]) == 0
    small = read_bundle(output)
    assert output.stat().st_size < 0.7 * source.stat().st_size
    assert small.grid.is_mesh and len(small) < 2 * 98
