"""Corrections are functions of the sequence: zero at first, shared by neighbours, never of one image."""

import numpy as np
import pytest
import torch
from tiny_avatar import write_tiny_capture

from cap4d.avatar.corrections import Corrections
from cap4d.camera import head_fixed
from cap4d.capture.capture import Capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    path = tmp_path_factory.mktemp("captures") / "sheet"
    write_tiny_capture(path)
    return Capture.load(path)


@pytest.fixture
def corrections(capture):
    trained = np.ones(len(capture), bool)
    trained[[9, 19, 22, 23]] = False
    return Corrections(capture, trained, np.array([0.01, 0.02, 0.03]), video=True)


def test_they_start_at_what_was_tracked(capture, corrections):
    with torch.no_grad():
        c = corrections.at(5)
    torch.testing.assert_close(c.pose.expr, torch.from_numpy(capture.expr[5]))
    torch.testing.assert_close(c.rigid[0], torch.eye(3))
    assert c.rigid[1].abs().max() < 1e-7
    assert not corrections.penalty(0).detach().any()


def test_a_held_out_frame_gets_its_neighbours_correction(corrections):
    with torch.no_grad():  # frames 8 and 10; the seventh output is the first expression
        corrections.residual[[8, 9], 6] = torch.tensor([1.0, 3.0])
    unit = 0.05
    with torch.no_grad():
        steps = [float(corrections.at(t).pose.expr[0] - corrections.expr[t, 0]) / unit for t in (8, 9, 10, 0)]
    assert 1.5 < steps[1] < 2.5
    assert steps[0] < steps[1] < steps[2]
    assert abs(steps[3]) < 1e-6


def test_stills_share_no_residual(capture):
    trained = np.ones(len(capture), bool)
    trained[3] = False
    stills = Corrections(capture, trained, np.zeros(3), video=False)
    with torch.no_grad():
        stills.residual[2, 6] = 1.0  # of frame 2
        changed = [abs(float(stills.at(t).pose.expr[0] - stills.expr[t, 0])) > 1e-6 for t in range(6)]
    assert changed == [False, False, True, False, False, False]


def test_the_last_residual_fades_beyond_the_last_trained_frame(corrections):
    with torch.no_grad():
        corrections.residual[-1, 6] = 2.0  # of frame 21
        last, beyond = (corrections.at(t).pose.expr[0] - corrections.expr[t, 0] for t in (22, 23))
    assert 0.1 > float(last) > float(beyond) > 0.05


def test_the_linear_map_reaches_frames_without_an_image(corrections):
    with torch.no_grad():
        corrections.linear[:, 6] = corrections.features[23]
        assert abs(float(corrections.at(23).pose.expr[0] - corrections.expr[23, 0])) > 1e-4


def test_the_corrected_clip_sees_what_the_corrected_view_sees(capture, corrections):
    """The rigid correction applied to points, then the tracked camera = the corrected camera."""
    with torch.no_grad():
        corrections.residual[:] = torch.randn(
            corrections.residual.shape, generator=torch.Generator().manual_seed(0)
        )
    clip = corrections.corrected(capture.clip())
    points = np.random.default_rng(0).normal(0, 0.1, (10, 3))
    t = 7
    rotmat, shift = (x.detach().double().numpy() for x in corrections.at(t).rigid)
    world = np.eye(4)
    tracked = head_fixed(world, capture.rot[t], capture.tra[t])
    corrected = head_fixed(world, clip.rot[t], clip.tra[t])
    moved = points @ rotmat.T + shift
    expected = moved @ tracked[:3, :3].T + tracked[:3, 3]
    found = points @ corrected[:3, :3].T + corrected[:3, 3]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(clip.rot - capture.rot).max() > 1e-3
