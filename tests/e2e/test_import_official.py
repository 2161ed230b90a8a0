"""An avatar of the released system, imported and played, against the same worked out here in float64.

Everything below the command is written from the facts alone: the head, the grid, the network and the
Gaussians share no code with the package (but the reader of FLAME's pickle).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnx")

import torch
from official_checkpoint import write_official
from test_road import run
from torch.nn import functional
from x_server import PLAY, needs_x
from x_server import run as run_window

from cap4d.capture.image import read_image
from cap4d.cli import main

SIZE, STD = 128, 0.0108
FLIP = np.array([1.0, -1.0, -1.0])  # fact 10


def rodrigues(turn: np.ndarray) -> np.ndarray:
    """Fact 9."""
    angle = np.sqrt(max(turn @ turn, 1e-8))
    x, y, z = turn / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


@dataclass
class Flame:
    """The head of facts 1-15, float64, straight from its files."""

    model: dict
    blink: np.ndarray
    jaw_regressor: np.ndarray

    def vertices(self, shape: np.ndarray, expr: np.ndarray, eye_rot: np.ndarray) -> np.ndarray:
        """[5423, 3] m, FLAME's axes: head, upper mouth, lower mouth."""
        m, shapedirs = self.model, self.model["shapedirs"]
        shaped = m["v_template"] + shapedirs[..., :150] @ shape
        expressed = shaped + shapedirs[..., 300:364] @ expr[:64] + self.blink * expr[64]
        joints = m["J_regressor"] @ expressed
        turns = [np.eye(3)] * 3 + [rodrigues(eye_rot)] * 2
        feature = np.concatenate([(turns[j] - 2 * np.eye(3)).ravel() for j in (0, 2, 3, 4)])  # fact 8
        corrected = expressed + m["posedirs"] @ feature
        head = sum(
            m["weights"][:, j, None] * ((corrected - joints[j]) @ turns[j].T + joints[j]) for j in range(5)
        )
        jaw = m["J_regressor"][2] @ shaped
        mouth = self.mouth(jaw, shaped[3533])
        lower = (mouth - jaw) @ rodrigues(expr @ self.jaw_regressor).T + jaw
        return np.concatenate([head, mouth, lower])

    def mouth(self, jaw: np.ndarray, lip: np.ndarray) -> np.ndarray:
        """[200, 3] fact 12."""
        ball = []
        for ring in range(10):
            latitude = -np.pi / 2 + ring * np.pi / 19
            for step in range(20):
                longitude = 2 * np.pi * step / 19
                across = np.cos(latitude)
                ball.append((across * np.cos(longitude), -across * np.sin(longitude), -np.sin(latitude)))
        away = lip - jaw
        radius, z = 0.25 * np.linalg.norm(away), away / np.linalg.norm(away)
        x = np.cross([0, 1, 0], z)
        x /= np.linalg.norm(x)
        frame = np.stack([x, np.cross(z, x), z])
        return radius * np.array(ball) @ frame + jaw + 0.75 * away - 0.005 * z


def read_template(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """uv [T, 2], faces [F, 3], uv faces [F, 3] of an OBJ."""
    uv, faces, uv_faces = [], [], []
    for line in path.read_text().splitlines():
        word, *rest = line.split() or [""]
        if word == "vt":
            uv.append([float(x) for x in rest[:2]])
        elif word == "f":
            corners = [[int(n) - 1 for n in corner.split("/")[:2]] for corner in rest]
            for a, b in pairwise(corners[1:]):
                faces.append([corners[0][0], a[0], b[0]])
                uv_faces.append([corners[0][1], a[1], b[1]])
    return np.array(uv), np.array(faces), np.array(uv_faces)


@dataclass
class Grid:
    """Facts 16-19: `face` [128, 128] or -1, `bary` [128, 128, 3], `faces` [28120, 3] into all pixels."""

    face: np.ndarray
    bary: np.ndarray
    faces: np.ndarray
    deformable: np.ndarray
    template_faces: np.ndarray

    @classmethod
    def of(cls, assets: Path) -> Grid:
        uv, faces, uv_faces = read_template(assets / "cap4d_avatar_template.obj")
        places = np.stack([(1 - uv[:, 0]) * SIZE, uv[:, 1] * SIZE], -1)  # column, row
        face, bary = np.full((SIZE, SIZE), -1), np.zeros((SIZE, SIZE, 3))
        for f, corners in enumerate(places[uv_faces]):
            (ax, ay), (bx, by), (cx, cy) = corners
            area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            if area >= -1e-12:  # those that face away, and those without area
                continue
            low, high = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int)
            for row in range(max(low[1], 0), min(high[1], SIZE)):
                for column in range(max(low[0], 0), min(high[0], SIZE)):
                    x, y = column + 0.5, row + 0.5
                    b = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
                    c = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
                    if min(b, c, 1 - b - c) >= 0:
                        face[row, column], bary[row, column] = f, (1 - b - c, b, c)
        valid, cells = face >= 0, []
        for c in range(SIZE - 1):
            for r in range(SIZE - 1):
                for triangle in (((r, c), (r + 1, c), (r + 1, c + 1)), ((r, c), (r + 1, c + 1), (r, c + 1))):
                    if all(valid[p] for p in triangle):
                        cells.append([p[0] * SIZE + p[1] for p in triangle])
        soft = np.zeros(len(faces) + 10_000, bool)
        soft[np.loadtxt(assets / "deformable_verts.txt", dtype=int)] = True
        deformable = soft[faces[face]].all(-1) & valid
        return cls(face, bary, np.array(cells), deformable, faces)

    def points(self, vertices: np.ndarray) -> np.ndarray:
        """[128, 128, 3]"""
        return np.einsum("rck,rckd->rcd", self.bary, vertices[self.template_faces[self.face]])


def unet(state: dict[str, torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    """Fact 22, spelt out by the names of its 24 tensors."""
    state = {name: value.double() for name, value in state.items()}
    prefixes = ["model.model.1" + ".model.3" * i for i in range(5)]
    down = [("model.model.0", False)] + [(f"{p}.model.1", i < 4) for i, p in enumerate(prefixes)]
    up = [(f"{p}.model.{3 if i == 4 else 5}", True) for i, p in enumerate(prefixes)][::-1]
    skips = []
    for i, (name, norm) in enumerate(down):
        x = functional.leaky_relu(x, 0.2) if i else x
        x = functional.conv2d(x, state[f"{name}.weight"], state[f"{name}.bias"], stride=2, padding=1)
        x = instance_norm(x) if norm else x
        skips.append(x)
    for i, (name, norm) in enumerate([*up, ("model.model.3", False)]):
        x = skips.pop() if i == 0 else torch.cat([skips.pop(), x], 1)
        x = functional.conv_transpose2d(
            x.relu(), state[f"{name}.weight"], state[f"{name}.bias"], stride=2, padding=1
        )
        x = instance_norm(x) if norm else x
    return x


def instance_norm(x: torch.Tensor) -> torch.Tensor:
    mean = x.mean((2, 3), keepdim=True)
    return (x - mean) / (x.var((2, 3), keepdim=True, unbiased=False) + 1e-5).sqrt()


def deformation(state: dict[str, torch.Tensor], offsets: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """[128, 128, 3] m of offsets [128, 128, 3] m: facts 20, 21, 23."""
    at = np.arange(SIZE) / SIZE * 2 - 1
    waves = [f(at * 2.0**k) for f in (np.sin, np.cos) for k in range(6)]
    rows = [np.repeat(w[:, None], SIZE, 1) for w in waves]
    columns = [np.repeat(w[None], SIZE, 0) for w in waves]
    planes = [*np.moveaxis(offsets * valid[..., None] / STD, -1, 0), *rows, *columns]
    answer = unet(state, torch.from_numpy(np.stack(planes))[None])
    return np.moveaxis(answer[0].numpy(), 0, -1) * STD


@dataclass
class Direct:
    """The released avatar, worked out from its checkpoint."""

    flame: Flame
    grid: Grid
    state: dict

    def pose(self, expr: np.ndarray, eye_rot: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """means [N, 3] m, rotation matrices [N, 3, 3], scales [N, 3] m, OpenCV axes."""
        shape, net = self.state["shape"].double().numpy(), self.state["deform_net"]
        still = self.flame.vertices(shape, 0 * expr, 0 * eye_rot) * FLIP
        moved = self.flame.vertices(shape, expr, eye_rot) * FLIP
        valid = self.grid.face >= 0
        offsets = self.grid.points(moved - still)
        neutral = deformation(net, 0 * offsets, valid)
        answer = np.where(self.grid.deformable[..., None], deformation(net, offsets, valid), neutral)
        corners = (self.grid.points(moved) + answer).reshape(-1, 3)[self.grid.faces]
        return self.bound(corners)

    def bound(self, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fact 27."""
        _, xyz, _, _, scaling, rotation, _, binding, *_ = self.state["gaussians"]
        v0, v1, v2 = np.moveaxis(corners[binding.numpy()], 1, 0)
        a0 = normalized(v1 - v0)
        a1 = normalized(np.cross(a0, v2 - v0))
        a2 = -np.cross(a1, a0)
        size = (np.linalg.norm(v1 - v0, axis=1) + abs((a2 * (v2 - v0)).sum(1))) / 2
        frame = np.stack([a0, a1, a2], -1)
        local = xyz.detach().double().numpy()
        means = np.einsum("nij,nj->ni", frame, local) * size[:, None] + (v0 + v1 + v2) / 3
        turns = frame @ matrices(normalized(rotation.detach().double().numpy()))
        return means, turns, np.exp(scaling.detach().double().numpy()) * size[:, None]


def normalized(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def matrices(quats: np.ndarray) -> np.ndarray:
    """[N, 3, 3] of unit quaternions wxyz."""
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


@pytest.fixture(scope="module")
def road(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("official")
    (folder / "model").mkdir()
    write_official(folder / "model", gaussians=30_000, width=4)
    (folder / "model/chkpnt9000.pth").write_bytes(b"an older one")
    run("import", "official", folder / "model", "--flame", shared / "flame/flame_standin.pkl",
        "--assets", shared / "flame/cap4d_assets", "-o", folder / "avatar.cap4d")  # fmt: skip
    return folder


def test_it_poses_as_the_released_code_does(road: Path, shared: Path) -> None:
    import cap4d
    from cap4d.rig.unpickle import read_pickle

    assets = shared / "flame/cap4d_assets"
    content = read_pickle(shared / "flame/flame_standin.pkl")
    model = {k: v.astype(np.float64) for k, v in content.items() if isinstance(v, np.ndarray)}
    blink, jaw = (np.load(assets / f"{n}.npy").astype(float) for n in ("blink_blendshape", "jaw_regressor"))
    grid = Grid.of(assets)
    assert (grid.face >= 0).sum() == 14_425 and len(grid.faces) == 28_120 and grid.deformable.sum() == 8_424
    state, _ = torch.load(road / "model/chkpnt100000.pth", weights_only=False)  # our own
    direct = Direct(Flame(model, blink, jaw), grid, state)
    avatar = cap4d.Avatar.load(road / "avatar.cap4d", deformer="full")
    with np.load(shared / "flame/sequence_00/fit.npz") as sequence:
        frames = [(sequence["expr"][t], sequence["eye_rot"][t]) for t in (0, 97, 311)]
    errors, deformed = [], []
    for expr, eye_rot in [(0 * frames[0][0], 0 * frames[0][1]), *frames]:
        means, turns, scales = direct.pose(expr.astype(float), eye_rot.astype(float))
        found = avatar.pose(expr, eye_rot=eye_rot)
        errors.append(np.linalg.norm(found.means - means, axis=1).max())
        deformed.append(np.abs(avatar.deformation()).max())
        turned = np.abs(matrices(normalized(found.quats.astype(float))) - turns).max((1, 2))
        assert np.quantile(turned, 0.999) < 1e-3 and turned.max() < 2e-2  # slivers turn far in float32
        np.testing.assert_allclose(found.scales, scales, rtol=1e-3)
    print(f"Gaussians are off by at most {1e3 * max(errors):.6f} mm, where the network moves "
          f"{1e3 * max(deformed):.2f} mm")  # fmt: skip
    assert max(errors) < 1e-5
    assert min(deformed) > 1e-3, "the network has a say"
    fields = state["gaussians"]
    np.testing.assert_array_equal(avatar.bundle.binding, fields[7])
    np.testing.assert_array_equal(avatar.bundle.sh[:, 1:], fields[3].detach())


def test_it_plays_headless(road: Path, shared: Path) -> None:
    printed = run("inspect", road / "avatar.cap4d")
    assert "flame2023_no_jaw" in printed and "30000" in printed.replace(",", "")
    run("view", road / "avatar.cap4d", "--headless", "--backend", "cpu", "--size", "128x128", "--frames", 60,
        "--drive", shared / "flame/sequence_00/fit.npz", "--out", road / "out_%02d.png")  # fmt: skip
    first, *_, last = (read_image(path).astype(float) for path in sorted(road.glob("out_*.png")))
    assert (np.abs(first - last).max(-1) > 0.06).sum() > 100, "the sequence moves the face"


@needs_x
def test_it_plays_in_the_window(road: Path) -> None:
    found, said = run_window(PLAY.replace("NAME", "'avatar.cap4d'"), road)
    assert found["rig"] == "flame2023_no_jaw" and found["tier"] != "off"
    assert found["messages"] == [] and said == ""


def test_bad_files_are_refused_with_one_line_and_nothing_is_written(
    road: Path, shared: Path, capsys: pytest.CaptureFixture
) -> None:
    whole = (road / "model/chkpnt100000.pth").read_bytes()
    (road / "model/chkpnt100001.pth").write_bytes(whole[: len(whole) // 2])
    words = ["import", "official", str(road / "model"), "-o", str(road / "x.cap4d")]
    words += ["--flame", str(shared / "flame/flame_standin.pkl"), "--assets"]
    assert main([*words, str(shared / "flame/cap4d_assets")]) == 1
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith("cap4d: ") and line.endswith("File is not a zip file")
    (road / "model/chkpnt100001.pth").unlink()
    assert main([*words, str(road)]) == 1
    *before, line = capsys.readouterr().err.splitlines()
    assert line.startswith("cap4d: ") and "cap4d_avatar_template.obj" in line and len(before) <= 1
    assert not (road / "x.cap4d").exists() and not list(road.glob(".*"))
