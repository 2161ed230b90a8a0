"""LPIPS against its formula written out, as a distance, and against files that are not its weights."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from tiny_vgg import CONVOLUTIONS, tiny_linear_state, tiny_vgg_state, write_tiny_vgg

from cap4d.errors import ArgumentError, DataError
from cap4d.perceptual.lpips import LINEAR_FILE, TRUNK_FILE, Lpips, LpipsFiles, find_lpips, load_lpips


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    return load_lpips(write_tiny_vgg(tmp_path_factory.mktemp("vgg")), width=4)


def picture(seed=0, height=32, width=40):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.uniform(-1, 1, (height, width, 3)).astype(np.float32))


def slow_lpips(x, y, vgg, linear):
    """From the state dicts themselves, in float64: torchvision's layers 0 to 29 one after the other."""
    pools, looks = (4, 9, 16, 23), (2, 7, 14, 21, 28)
    total = 0.0
    maps = []
    for image in (x, y):
        shift = torch.tensor([-0.030, -0.088, -0.188], dtype=torch.float64)
        scale = torch.tensor([0.458, 0.448, 0.450], dtype=torch.float64)
        z = ((image.double() - shift) / scale).permute(2, 0, 1)[None]
        seen = []
        for layer in range(29):
            if layer in pools:
                z = F.max_pool2d(z, 2)
            if layer in CONVOLUTIONS:
                w, b = (vgg[f"features.{layer}.{n}"].double() for n in ("weight", "bias"))
                z = F.conv2d(z, w, b, padding=1).clamp(min=0)
            if layer in looks:
                seen.append(z[0] / (z[0].norm(dim=0) + 1e-10))
        maps.append(seen)
    for i, (a, b) in enumerate(zip(*maps, strict=True)):
        weights = linear[f"lin{i}.model.1.weight"].double()[0]
        total += float((weights * (a - b) ** 2).sum(0).mean())
    return total


def test_it_is_its_formula(network):
    x, y = picture(0), picture(1)
    expected = slow_lpips(x, y, tiny_vgg_state(), tiny_linear_state())
    assert expected > 0.1
    assert abs(float(network(x, y)) - expected) < 1e-5 * expected


def test_it_is_a_distance(network):
    """Zero for equals, the same both ways, positive, and greater for greater damage."""
    x, noise = picture(0), picture(1)
    assert float(network(x, x)) == 0
    damaged = [float(network(x, (1 - t) * x + t * noise)) for t in (0.1, 0.3, 1.0)]
    assert 0 < damaged[0] < damaged[1] < damaged[2]
    assert float(network(x, noise)) == pytest.approx(float(network(noise, x)), rel=1e-6)


def test_the_root_of_one_depth_obeys_the_triangle_inequality(network):
    a, b, c = ([m.double() for m in network.features(picture(i))] for i in range(3))
    for x, y, z, w in zip(a, b, c, network.weights, strict=True):
        ab, bc, ac = (
            float((w[:, None, None] * (p - q).square()).sum(0).mean().sqrt())
            for p, q in ((x, y), (y, z), (x, z))
        )
        assert ac <= ab + bc


def test_its_gradient(network):
    double = Lpips(width=4).double()
    double.load_state_dict({k: v.double() for k, v in network.state_dict().items()})
    x, y = picture(0, 16, 16).double(), picture(1, 16, 16).double()
    x.requires_grad_()
    double(x, y).backward()
    rng = np.random.default_rng(0)
    direction = torch.from_numpy(rng.normal(size=x.shape))
    h = 1e-6  # small enough to cross hardly a ReLU
    with torch.no_grad():
        slope = (double(x + h * direction, y) - double(x - h * direction, y)) / (2 * h)
    assert float((x.grad * direction).sum()) == pytest.approx(float(slope), rel=1e-5)


def test_a_pixel_without_any_feature_has_a_finite_gradient():
    dead = Lpips(width=2)
    for weights in dead.weights:
        weights.fill_(1.0)
    for convolution in (c for stage in dead.stages for c in stage):
        convolution.bias.fill_(-100.0)
    x = picture().requires_grad_()
    dead(x, picture(1)).backward()
    assert torch.equal(x.grad, torch.zeros_like(x))


def test_nothing_of_it_is_trained(network):
    assert not any(p.requires_grad for p in network.parameters())


@pytest.mark.parametrize("shape", [(32, 32), (3, 32, 32), (15, 32, 3)])
def test_images_of_another_shape_are_refused(network, shape):
    with pytest.raises(ArgumentError, match="image: expected"):
        network(torch.zeros(shape), torch.zeros(shape))


def test_the_real_width_takes_the_published_shapes():
    shapes = [c.weight.shape for stage in Lpips().stages for c in stage]
    assert shapes[0] == (64, 3, 3, 3)
    assert shapes[-1] == (512, 512, 3, 3)
    assert sum(p.numel() for stage in Lpips().stages for p in stage.parameters()) == 14_714_688  # VGG16's


# finding and loading --------------------------------------------------------------------------------------


def test_a_folder_with_both_files(tmp_path):
    files = write_tiny_vgg(tmp_path)
    assert find_lpips(tmp_path) == files
    files.linear.unlink()
    with pytest.raises(ArgumentError, match=r"expected vgg\.pth in .*https://"):
        find_lpips(tmp_path)


def test_torch_hubs_cache_is_looked_at(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert find_lpips(None) is None
    cache = tmp_path / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    assert find_lpips(None) is None
    write_tiny_vgg(cache)
    assert find_lpips(None) == LpipsFiles(cache / TRUNK_FILE, cache / LINEAR_FILE)


def missing(vgg, linear):
    del vgg["features.28.bias"]


def left_over(vgg, linear):
    linear["lin5.model.1.weight"] = torch.zeros(1, 4, 1, 1)


def misshapen(vgg, linear):
    vgg["features.0.weight"] = torch.zeros(4, 4, 3, 3)


def not_finite(vgg, linear):
    linear["lin2.model.1.weight"][0, 3] = float("nan")


def whole_numbers(vgg, linear):
    vgg["features.0.bias"] = torch.zeros(4, dtype=torch.int64)


@pytest.mark.parametrize(
    ("abuse", "field"),
    [
        (missing, "features.28.bias"),
        (left_over, "lin5.model.1.weight"),
        (misshapen, "features.0.weight"),
        (not_finite, "lin2.model.1.weight"),
        (whole_numbers, "features.0.bias"),
    ],
)
def test_weights_of_something_else_are_refused(tmp_path, abuse, field):
    vgg, linear = tiny_vgg_state(), tiny_linear_state()
    abuse(vgg, linear)
    files = LpipsFiles(tmp_path / TRUNK_FILE, tmp_path / LINEAR_FILE)
    torch.save(vgg, files.trunk)
    torch.save(linear, files.linear)
    with pytest.raises(DataError, match=field):
        load_lpips(files, width=4)


class Trap:
    """What a hostile pickle would run."""

    def __reduce__(self):
        return (print, ("ran",))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no zip", "trap", "list", "number"])
def test_what_is_no_state_dict_is_refused(tmp_path, capsys, content):
    files = write_tiny_vgg(tmp_path)
    if isinstance(content, bytes):
        files.trunk.write_bytes(content)
    else:
        torch.save({"trap": {"x": Trap()}, "list": [1], "number": {"x": 1}}[content], files.trunk)
    with pytest.raises(DataError, match="weights: expected a state dict"):
        load_lpips(files, width=4)
    assert "ran" not in capsys.readouterr().out
