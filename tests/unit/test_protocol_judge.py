"""What judges a protocol's cells: refused before any fit, known by what it can measure."""

import pytest

from cap4d import cli
from cap4d.errors import ArgumentError, DataError
from cap4d.evaluate.metrics.weights import Weights
from cap4d.evaluate.protocols.judge import judge_by_metrics


def test_what_cannot_judge_is_refused_before_any_fit(tmp_path):
    with pytest.raises(ArgumentError, match="got VMAF"):
        judge_by_metrics(Weights(), ("PSNR", "VMAF"))
    with pytest.raises(ArgumentError, match=r"none\.onnx: cannot be read"):
        judge_by_metrics(Weights(arcface=tmp_path / "none.onnx"), ("PSNR",))
    (tmp_path / "broken.onnx").write_bytes(b"\x08\x07 no network")
    with pytest.raises(DataError, match="ONNX that loads"):
        judge_by_metrics(Weights(arcface=tmp_path / "broken.onnx"), ("CSIM",))


def test_the_command_says_so_in_one_line(tmp_path, capsys):
    command = ["protocol", "self-reenactment", str(tmp_path), "--rig", "none.npz", "-o", str(tmp_path / "x")]
    assert cli.main([*command, "--metrics", "PSNR,VMAF"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "x").exists()


def test_cells_are_judged_again_when_more_can_be_measured(tmp_path, monkeypatch):
    pytest.importorskip("torch", reason="needs the extra [fit]")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "empty"))
    without = judge_by_metrics(Weights(), ("PSNR", "LPIPS"))[1]
    assert without == judge_by_metrics(Weights(), ("PSNR", "LPIPS"))[1]
    monkeypatch.setattr("cap4d.evaluate.metrics.lpips.find", lambda weights: _Found())
    assert judge_by_metrics(Weights(), ("PSNR", "LPIPS"))[1] != without


class _Found:
    name = "LPIPS"
