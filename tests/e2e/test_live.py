"""A CodeTalker clip streamed through a socket that loses 5 % of it, 40 ms late: the lips follow."""

from __future__ import annotations

from pathlib import Path

import pytest
from rehearsal import rehearse, speaker

from cap4d.drive.impair import Impairment


@pytest.mark.parametrize(
    "impairment", [Impairment(), Impairment(loss=0.05, jitter=0.04, reorder=0.05)], ids=["clean", "bad"]
)
def test_lips_follow_a_speech_model_through_a_socket(shared: Path, impairment: Impairment) -> None:
    bundle, vertices, truth, template = speaker(shared)
    seen = rehearse(bundle, vertices, template, impairment, seconds=4)
    error, worst = seen.error(truth)
    delay, likeness = seen.delay(truth)
    found = seen.statistics
    print(
        f"\nlatency {found['latency_ms']}; {found['late']} late, {found['dropped']} dropped, "
        f"{found['interpolated']} of {found['frames']} pictures mixed, {seen.lost} of {seen.sent} lost; "
        f"expressions off by {error:.4f} rms, {worst:.3f} at worst; they spread by {truth.std():.3f}"
    )
    assert 0 <= seen.sent - seen.lost - found["received"] < 6  # on their way at the end
    fates = found["shown"] + found["dropped"] + found["waiting"] + sum(found["rejected"].values())
    assert fates == found["received"]
    assert set(found["rejected"]) <= {"late"} and found["late"] < 0.1 * seen.sent
    assert (
        error < 0.05 * truth.std()
    )  # straight lines over lost frames; a hundredth of the spread without loss
    assert likeness > 0.99
    on_the_line = 1e3 * delay - found["latency_ms"]["median"]  # what is measured is what is seen
    assert -15 < on_the_line < 1e3 * (impairment.jitter + 0.02)
    assert found["latency_ms"]["median"] < 200 and found["latency_ms"]["p95"] < 300
    assert found["interpolated"] > 0.8 * found["frames"]
