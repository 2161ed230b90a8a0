"""`cap4d bench` from the command line to its files, on almost nothing. Times are never looked at."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from tiny_bundle import tiny_bundle, tiny_bundle_on_mesh

from cap4d import cli
from cap4d.bundle import write_bundle
from cap4d.errors import ArgumentError
from cap4d.evaluate.bench import peers
from cap4d.evaluate.bench.child import ChildError, in_child
from cap4d.evaluate.bench.deforming import measure_deformer
from cap4d.evaluate.bench.fitting import FUSED, TORCH
from cap4d.evaluate.bench.plots import draw_plots
from cap4d.evaluate.bench.run import parse_sections, try_plots
from cap4d.evaluate.bench.scenes import SceneSource
from cap4d.evaluate.bench.settings import SECTIONS, Settings
from cap4d.evaluate.bench.tiled import render_tiled


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a quick run of everything on a tiny avatar, and what it printed in `printed.txt`."""
    folder = tmp_path_factory.mktemp("bench")
    avatar = folder / "tiny.cap4d"
    write_bundle(tiny_bundle(), avatar)
    with pytest.MonkeyPatch.context() as patch, open(folder / "printed.txt", "w") as printed:
        patch.setattr(sys, "stdout", printed)
        words = [
            "bench",
            "--quick",
            "--report",
            str(folder / "out"),
            "--avatar",
            str(avatar),
            "--threads",
            "2",
        ]
        assert cli.main(words) == 0
    return folder


def test_everything_is_measured_and_written(report: Path) -> None:
    found = json.loads((report / "out" / "report.json").read_text())
    assert found["schema"] == 1 and found["quick"] is True
    assert set(SECTIONS) - {"optimize"} <= set(found)
    assert any(line.startswith("optimize: ") for line in found["not_measured"])
    assert found["machine"]["threads"] == 2 and set(found["ceilings"]) == {"1", "2"}
    assert found["command"].startswith("cap4d bench --report") and found["command"].endswith("--quick")
    names = {row["name"] for row in found["splat"]["scenes"]}
    assert names == {"head_30k", "head_100k", "head_300k", "bad_30k", "bad_100k"}
    assert not list((report / "out").glob(".*"))


def test_the_numbers_of_the_splatter_hang_together(report: Path) -> None:
    splat = json.loads((report / "out" / "report.json").read_text())["splat"]
    for row in splat["scenes"]:
        assert row["work"]["gaussians"] == 10 * int(row["name"].split("_")[1][:-1])
        assert (
            row["work"]["blended"] <= row["work"]["inside"]
            and row["work"]["blended"] <= row["work"]["lanes"]["16"]
        )
        assert row["error"]["stateless"]["psnr_db"] > 80 and row["error"]["psnr_db"] > 60
        for name in ("forward", "forward_backward"):
            assert row["of_floor"][name] == pytest.approx(
                row["floor_ms"][name] / row[name]["median_ms"], rel=0.1, abs=2e-3
            )
            assert row[name]["least_ms"] <= row[name]["median_ms"] <= row[name]["p95_ms"]
    assert all(error < 1e-3 for name, error in splat["gradients"][0].items() if name != "name")
    assert [r["sh_degree"] for r in splat["scaling"]["sh_degree"]] == [0, 1, 2, 3]
    assert [r["threads"] for r in splat["scaling"]["threads"]] == [1, 2]
    assert splat["scaling"]["isa"][0]["isa"] == "base" and splat["scaling"]["isa"][-1]["isa"] == splat["isa"]
    for entry in splat["roofline"]:
        assert entry["floor_ms"] == pytest.approx(sum(s["ms"] for s in entry["stages"]), abs=2e-3)


def test_all_steps_of_adam_are_the_same(report: Path) -> None:
    fit = json.loads((report / "out" / "report.json").read_text())["fit"]
    assert fit["values"] == 1_000 * 59
    assert [step["name"] for step in fit["steps"]] == [TORCH, FUSED]
    assert all(step["difference"] < 1e-6 for step in fit["steps"])


def test_the_avatar_is_measured_in_each_of_its_tiers(report: Path) -> None:
    found = json.loads((report / "out" / "report.json").read_text())
    deformer, frame = found["deformer"][0], found["frame"][0]
    tiers = [row["tier"] for row in deformer["tiers"]]
    assert tiers[0] == deformer["truth"] == "full" and tiers[-1] == "off"
    errors = {row["tier"]: row["error"] for row in deformer["tiers"]}
    assert errors["full"] == {"rms_mm": 0, "max_mm": 0} and errors["off"]["rms_mm"] > 0
    assert [row["pass"] is None for row in deformer["tiers"]] == [False] * (len(tiers) - 1) + [True]
    assert len(deformer["plain"]) == 2
    rows = {row["name"]: row for row in frame["tiers"]}
    assert list(rows)[:2] == ["full", "full, pipelined"] and "off, pipelined" not in rows
    assert rows["full"]["psnr_db"] == rows["full, pipelined"]["psnr_db"]
    assert rows["full"]["psnr_db"] > 50 > rows["off"]["psnr_db"] > 10
    assert rows["full"]["memory_mb"] > 20 and rows["full"]["stages"]["frame"]["median_ms"] > 0
    plans = {(c["tier"], c["sh_degree"], c["side"]) for c in frame["configurations"]}
    assert len(plans) == len(frame["configurations"]) == len(tiers) * (2 + 2)


def test_the_page_shows_the_tables_the_plots_and_how_to_repeat_it(report: Path) -> None:
    out = report / "out"
    page = (out / "report.md").read_text()
    plots = {path.name for path in out.glob("*.png")}
    assert plots == {
        *("splat_scaling.png", "splat_roofline.png", "deformer.png"),
        *("frame_times.png", "frame_pareto.png", "peers.png"),
    }
    assert all(f"({name})" in page and (out / name).read_bytes()[:4] == b"\x89PNG" for name in plots)
    for text in (
        "the numbers mean nothing",
        "What it must show",
        "Protocol",
        "    cap4d bench",
        "tiny.cap4d",
    ):
        assert text in page, text
    heads = [line for line in page.splitlines() if line.startswith("| ---")]
    assert len(heads) > 12


def test_a_quick_run_prints_lines_without_verdicts(report: Path) -> None:
    printed = (report / "printed.txt").read_text().splitlines()
    assert printed[-1].endswith("report.md: --quick: the numbers mean nothing")
    assert any("head_100k forward" in line for line in printed)
    assert not [line for line in printed if line.startswith(("pass", "FAIL"))]


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["--only", "splat,nonsense"], 2, "only: expected names of"),
        (["--only", ""], 2, "got nothing"),
        (["--threads", "0"], 2, "threads: expected 1 to 256"),
        (["--scenes", "nowhere"], 2, "scenes: expected a folder"),
        (["--scenes", "."], 1, "cameras.json"),
        (["--avatar", "nowhere.cap4d"], 1, "nowhere.cap4d"),
        (["--report", "file"], 2, "report: expected a folder"),
        (["--report", "no/where"], 2, "does not exist"),
    ],
)
def test_bad_input_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    words: list[str],
    code: int,
    text: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    assert cli.main(["bench", "--quick", "--report", "out", *words]) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and text in lines[0]


def test_help_has_an_example(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["bench", "--help"])
    assert stop.value.code == 0 and "cap4d bench --report" in capsys.readouterr().out


def test_sections_are_names_with_commas() -> None:
    assert parse_sections("splat, fit") == ("splat", "fit")
    with pytest.raises(ArgumentError):
        parse_sections("everything")


def test_a_child_that_fails_says_why() -> None:
    with pytest.raises(ChildError, match="CAP4D_ISA"):
        in_child(
            "splat",
            environment={"CAP4D_ISA": "z80"},
            folder=None,
            name="head_30k",
            count=9,
            threads=1,
            runs=1,
        )


def test_what_is_not_installed_is_said_and_not_made_up(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("gsplat", "nerfacc"):
        monkeypatch.setitem(sys.modules, name, None)
    scene = SceneSource().load("head_30k", count=30)
    found, missing = peers.find_peers(scene, Settings(quick=True))
    assert list(found) == ["NumPy, float32, tile by tile"]
    assert len(missing) == 1 and "needs the package" in missing[0]
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    report = {"not_measured": [], "peers": {"scenes": []}}
    assert try_plots(tmp_path, report) == [] and "matplotlib" in report["not_measured"][0]
    assert draw_plots(tmp_path, {}) == []


def test_gsplat_draws_the_same_picture_here() -> None:
    pytest.importorskip("gsplat")
    pytest.importorskip("nerfacc")
    scene = SceneSource().load("head_30k", count=300).resized(96)
    found, _ = peers.find_peers(scene, Settings(quick=True))
    truth = render_tiled(scene.gaussians, scene.camera).rgb
    for name, peer in found.items():
        assert abs(peer.forward() - truth).max() < 0.01, name
    found["gsplat's PyTorch functions, pairs given"].forward_backward()


def test_an_avatar_without_a_grid_has_no_deformer_to_measure(tmp_path: Path) -> None:
    write_bundle(tiny_bundle_on_mesh(8, gaussians=1), tmp_path / "a.cap4d")
    with pytest.raises(ArgumentError, match="expected an avatar on a UV grid"):
        measure_deformer(tmp_path / "a.cap4d", Settings(quick=True))
