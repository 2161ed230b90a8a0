"""The whole self-reenactment protocol, small: two sheets, 1 and 9 references, with and without U-Net."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tiny_avatar import GRID, tiny_rig
from tiny_ring import write_tiny_ring

from cap4d.avatar.presets import PRESETS, Densify
from cap4d.bundle import read_bundle
from cap4d.errors import ArgumentError, DataError
from cap4d.evaluate.metrics.weights import Weights
from cap4d.evaluate.protocols import cell as cell_module
from cap4d.evaluate.protocols.judge import judge_by_metrics
from cap4d.evaluate.protocols.self_reenactment import Protocol, plan, self_reenactment
from cap4d.rig.store import save_rig

TINY = replace(
    PRESETS["debug"],
    iterations=80,
    image_size=32,
    grid_size=GRID,
    deformer_width=4,
    gaussians=600,
    densify=Densify(start=1000, stop=1000, every=1000),
)
PROTOCOL = Protocol(preset=TINY, references=(1, 9), methods=("none", "unet"), hold_out=2, frames=2)
JUDGE, JUDGED_BY = judge_by_metrics(Weights(), ("PSNR", "SSIM"))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Folders of two people, and the rig's file."""
    root = tmp_path_factory.mktemp("people")
    write_tiny_ring(root / "ann", seed=0)
    write_tiny_ring(root / "bob", seed=5)
    save_rig(tiny_rig(), root / "tiny.npz")
    return [root / "ann", root / "bob"], root / "tiny.npz"


@pytest.fixture(scope="module")
def made(data, tmp_path_factory):
    output = tmp_path_factory.mktemp("protocol") / "table"
    return output, self_reenactment(*data, output, PROTOCOL, judge=JUDGE, judged_by=JUDGED_BY)


def test_every_cell_is_there(made):
    output, results = made
    assert [(r.cell.identity, len(r.cell.references), r.cell.method) for r in results] == [
        (person, count, method)
        for person in ("ann", "bob")
        for count in (1, 9)
        for method in ("none", "unet")
    ]
    assert all(np.isfinite(r.values["PSNR"]).all() and len(r.values["PSNR"]) == 4 for r in results)
    assert sorted(p.name for p in output.iterdir()) == [
        "cells", "page.html", "page.png", "report.json", "table.md", "truth",
    ]  # fmt: skip


def test_cells_are_spared_the_deformers_that_judge_nothing(made):
    tiers = {read_bundle(r.folder / "avatar.cap4d").tiers for r in made[1]}
    assert tiers == {("full", "off"), ("off",)}


def test_held_out_cameras_are_judged_and_never_trained_on(made):
    for result in made[1]:
        held_out = set(result.cell.hold_out)
        assert len(held_out) == 2
        assert {camera for camera, _ in result.cell.views} == held_out
        assert not held_out & {camera for camera, _ in result.cell.references}
        assert result.fit["train_frames"] == len(result.cell.references)


def test_more_references_are_better(made):
    for person in ("ann", "bob"):
        by_count = {
            len(r.cell.references): r.mean("PSNR")
            for r in made[1]
            if r.cell.identity == person and r.cell.method == "unet"
        }
        assert by_count[9] > by_count[1] + 0.5


def test_the_tables_say_what_was_measured(made):
    output, results = made
    text = (output / "table.md").read_text()
    report = json.loads((output / "report.json").read_text())
    ours = [r.mean("PSNR") for r in results if len(r.cell.references) == 9 and r.cell.method == "none"]
    assert f"| 9 | ours | {np.mean(ours):.2f} ± " in text
    assert "| 9 references over 1, ours |" in text
    assert [c["mean"]["PSNR"] for c in report["cells"]] == [r.mean("PSNR") for r in results]
    gains = report["gains"]["ours over without U-Net, 9 references"]["PSNR"]
    assert gains["mean"] == pytest.approx(
        np.mean([results[i].mean("PSNR") - results[i + 1].mean("PSNR") for i in (2, 6)])
    )


def test_the_page_shows_files_that_are_there(made):
    output = made[0]
    text = (output / "page.html").read_text()
    assert "<title>Self-reenactment</title>" in text
    sources = re.findall(r"src='([^']+)'", text)
    assert len(sources) == 2 * 2 * (1 + 4)  # people x views x columns
    assert all((output / source).is_file() for source in sources)


def test_a_finished_protocol_is_only_read(data, made, monkeypatch):
    monkeypatch.setattr(cell_module, "fit_cell", lambda *_: pytest.fail("fitted again"))

    def judge(*_):
        pytest.fail("judged again")

    again = self_reenactment(*data, made[0], PROTOCOL, judge=judge, judged_by=JUDGED_BY)
    assert [r.mean("PSNR") for r in again] == [r.mean("PSNR") for r in made[1]]


def test_what_a_change_touches_is_made_again(data, made):
    _, rig = data
    cell = plan(*data, PROTOCOL)[0]
    fitted, judged = cell_module.fit_digest(cell, rig), cell_module.judge_digest(cell, JUDGED_BY)
    for other in (
        replace(cell, seed=1),
        replace(cell, ablate="unet"),
        replace(cell, preset=replace(TINY, iterations=81)),
    ):
        assert cell_module.fit_digest(other, rig) != fitted
        assert cell_module.judge_digest(other, JUDGED_BY) == judged
    smaller = replace(cell, size=16)
    assert cell_module.fit_digest(smaller, rig) == fitted
    assert cell_module.judge_digest(smaller, JUDGED_BY) != judged
    image = cell.capture / "images" / cell.references[0][0] / f"{cell.references[0][1]:05d}.png"
    before = image.read_bytes()
    try:
        image.write_bytes(before + b"\0")
        assert cell_module.fit_digest(cell, rig) != fitted
    finally:
        image.write_bytes(before)


def test_a_cell_that_fails_does_not_lose_the_others(data, tmp_path, monkeypatch):
    def fail_without_network(cell, rig, avatar, fit=cell_module.fit_cell):
        if cell.ablate == "unet":
            raise RuntimeError("no memory")
        fit(cell, rig, avatar)

    monkeypatch.setattr(cell_module, "fit_cell", fail_without_network)
    one = replace(PROTOCOL, references=(1,), preset=replace(TINY, iterations=2))
    with pytest.raises(DataError, match="ann-1-unet: RuntimeError: no memory"):
        self_reenactment(data[0][:1], data[1], tmp_path / "table", one, judge=JUDGE, judged_by=JUDGED_BY)
    text = (tmp_path / "table" / "table.md").read_text()
    assert "failed: ann-1-unet" in text
    assert "| 1 | ours |" in text


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"methods": ("hair",)}, "ablate: .*hair"),
        ({"methods": ("mmdm",)}, "generated"),
        ({"references": (0,)}, "references"),
        ({"references": (100,)}, "references: expected 1 to 12, got 100"),
        ({"hold_out": 9}, "hold_out_cameras"),
        ({"size": 0}, "size: expected 16 to"),
        ({"frames": 0}, "frames: expected at least 1"),
        ({"reference_seed": -1}, "reference_seed: expected"),
        ({"hold_out": ("nobody",)}, "nobody"),
    ],
)
def test_what_cannot_be_made_is_refused_before_any_fit(data, change, found):
    with pytest.raises(ArgumentError, match=found):
        plan(*data, replace(PROTOCOL, **change))
