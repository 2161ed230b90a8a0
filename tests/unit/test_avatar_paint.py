"""First colours are those the images show; what no image shows begins opaque."""

import numpy as np
import torch
from tiny_avatar import tiny_avatar, tiny_camera, tiny_rig

from cap4d.avatar.model import Pose
from cap4d.avatar.paint import FLAKE_OPACITY, SH_C0, paint
from cap4d.avatar.views import FitView
from cap4d.camera import Camera

RED, BLUE = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.2, 0.9])


def view_of(pixels, *, aside=0.0):
    camera = tiny_camera(32)
    viewmat = np.eye(4)
    viewmat[:3, 3] = [aside, 0, 0.5]
    return FitView(0, 0, Camera(camera.K, viewmat, 32, 32), pixels.half(), None)


def test_left_is_red_and_right_is_blue():
    model = tiny_avatar(tiny_rig(), width=None)
    pixels = RED.expand(32, 32, 3).clone()
    pixels[:, 16:] = BLUE
    zero = torch.zeros(3)
    paint(model, [view_of(pixels)], [Pose(torch.zeros(2), zero, zero, zero)])
    colours = 0.5 + SH_C0 * model.gaussians["sh_dc"].detach()[:, 0]
    x = model.subject.neutral[model.faces.long()].mean(1)[model.binding.long(), 0]
    torch.testing.assert_close(colours[x < -0.03], RED.expand(int((x < -0.03).sum()), 3), atol=2e-3, rtol=0)
    torch.testing.assert_close(colours[x > 0.03], BLUE.expand(int((x > 0.03).sum()), 3), atol=2e-3, rtol=0)
    assert float(model.gaussians["opacity_logits"].detach().sigmoid().max()) < 0.11


def test_what_no_view_sees_takes_its_neighbours_colour_and_is_opaque():
    model = tiny_avatar(tiny_rig(), width=None)
    zero = torch.zeros(3)
    half_out = view_of(RED.expand(32, 32, 3), aside=-0.14)  # the left half of the sheet is out of the picture
    paint(model, [half_out], [Pose(torch.zeros(2), zero, zero, zero)])
    colours = 0.5 + SH_C0 * model.gaussians["sh_dc"].detach()[:, 0]
    torch.testing.assert_close(colours, RED.expand(len(colours), 3), atol=2e-3, rtol=0)
    opacity = model.gaussians["opacity_logits"].detach().sigmoid()
    x = model.subject.neutral[model.faces.long()].mean(1)[model.binding.long(), 0]
    torch.testing.assert_close(opacity[x < -0.03], torch.full_like(opacity[x < -0.03], FLAKE_OPACITY))
    assert float(opacity[x > 0.03].max()) < 0.11
