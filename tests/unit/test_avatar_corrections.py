"""Corrections are functions of the sequence: zero at first, shared by neighbours, never of one image."""

from copy import copy

import numpy as np
import pytest
import torch
from tiny_avatar import write_tiny_capture

from cap4d.avatar.corrections import Corrections, NeckOffsets, Uncorrected, corrections_named
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


def test_neck_offsets_turn_the_neck_of_one_frame_and_are_kept(capture):
    neck = NeckOffsets(capture)
    assert float(neck.penalty(4).detach()) == 0
    optimizer = torch.optim.Adam(neck.parameters(), lr=0.01)
    for frame in (4, 4, 7):
        wanted = torch.tensor([0.1, 0.0, 0.0])
        optimizer.zero_grad(set_to_none=True)
        (neck.at(frame).pose.neck_rot - wanted).square().sum().backward()
        optimizer.step()
    moved = [t for t in range(len(capture)) if neck.offsets[t].detach().any()]
    assert moved == [4, 7]
    assert float(neck.penalty(4).detach()) == pytest.approx(0.02, rel=0.01)
    clip = neck.corrected(capture.clip())
    added = clip.neck_rot - capture.neck_rot
    np.testing.assert_allclose(added[4], [0.02, 0, 0], atol=1e-4)
    assert not np.delete(added, [4, 7], axis=0).any()
    assert np.array_equal(clip.expr, capture.expr)
    assert neck.at(4).rigid is None


def test_a_neck_at_rest_has_a_finite_gradient(capture):
    neck = NeckOffsets(capture)
    neck.penalty(2).backward()
    assert not neck.offsets[2].grad.any()


def test_trusted_parameters_stay_as_they_were_tracked(capture):
    trusted = Uncorrected(capture)
    assert not list(trusted.parameters())
    assert float(trusted.penalty(0)) == 0
    pose = trusted.at(6).pose
    for name in ("expr", "eye_rot", "neck_rot", "jaw_rot"):
        assert np.array_equal(getattr(pose, name).numpy(), getattr(capture, name)[6])
    clip = capture.clip()
    assert trusted.corrected(clip) is clip


def test_which_corrections_a_name_means(capture):
    calibrated = copy(capture)
    object.__setattr__(calibrated, "cameras", {"left": None, "right": None})
    arguments = np.ones(len(capture), bool), np.zeros(3)
    made = {
        name: type(corrections_named(name, capture, *arguments, video=True))
        for name in ("auto", "tracked", "neck", "none")
    }
    assert made == {"auto": Corrections, "tracked": Corrections, "neck": NeckOffsets, "none": Uncorrected}
    assert type(corrections_named("auto", calibrated, *arguments, video=False)) is Uncorrected
    assert type(corrections_named("tracked", calibrated, *arguments, video=False)) is Corrections
