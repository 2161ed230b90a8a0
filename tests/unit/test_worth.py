"""What views lose with each Gaussian, against taking them out one by one."""

import numpy as np
import pytest
import torch
from tiny_avatar import tiny_avatar, tiny_camera, tiny_rig

from cap4d.avatar.model import Pose
from cap4d.avatar.views import FitView
from cap4d.avatar.worth import removal_errors
from cap4d.raster import rasterize


@pytest.fixture(scope="module")
def scene():
    model = tiny_avatar(tiny_rig(), gaussians=150, width=None)
    model.gaussians["sh_dc"].data.uniform_(-1, 1, generator=torch.Generator().manual_seed(1))
    model.gaussians["opacity_logits"].data.uniform_(-2, 2, generator=torch.Generator().manual_seed(2))
    model.gaussians["means"].data[0] = 1e4  # out of every view
    camera = tiny_camera(24)
    camera.viewmat[2, 3] = 0.5
    view = FitView(0, 0, camera, torch.zeros(24, 24, 3), None)
    zero = torch.zeros(3)
    return model, view, Pose(torch.tensor([0.5, 0.2]), zero, zero, zero)


def drawn(posed, view, opacities):
    return rasterize(
        *(posed.means, posed.quats, posed.scales, opacities, posed.sh),
        camera=view.camera,
        background=(1.0, 1.0, 1.0),
        sh_degree=0,
    ).rgb


def test_it_is_the_error_of_taking_each_one_out(scene):
    model, view, pose = scene
    with torch.no_grad():
        posed = model.pose(pose)
        whole, exact = drawn(posed, view, posed.opacities), []
        for i in range(len(model)):
            without = posed.opacities.clone()
            without[i] = 0
            exact.append(float((drawn(posed, view, without) - whole).square().mean()))
    estimates = [
        removal_errors(
            lambda _: model.pose(pose),
            [view, view],
            sh_degree=0,
            generator=torch.Generator().manual_seed(seed),
        ).numpy()
        for seed in range(100)
    ]
    mean, exact = np.mean(estimates, 0), np.array(exact)
    assert mean[0] == 0 == exact[0]
    assert exact.max() > 1e-5
    big = np.argsort(exact)[-20:]  # 200 random squares each: their mean is good to a tenth
    np.testing.assert_allclose(mean[big], exact[big], rtol=0.4)
    assert np.corrcoef(mean, exact)[0, 1] > 0.98


def test_the_same_seed_gives_the_same_bits(scene):
    model, view, pose = scene
    a, b = (
        removal_errors(
            lambda _: model.pose(pose), [view], sh_degree=0, generator=torch.Generator().manual_seed(3)
        )
        for _ in range(2)
    )
    assert torch.equal(a, b)
