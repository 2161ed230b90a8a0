"""What a step must be: the same every time."""

from pathlib import Path

import pytest
import torch

from cap4d.avatar.fit import fit
from cap4d.avatar.trainer import rotation_term
from cap4d.errors import ArgumentError

SIDE = 120  # vertices a side: 28k triangles, as a real grid has


def test_the_rotation_term_gives_the_same_gradient_bits_on_two_threads():
    generator = torch.Generator().manual_seed(0)
    row, column = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    flat = torch.stack([column, row, 0 * row], -1).reshape(-1, 3) * 0.002
    surface = flat + 2e-4 * torch.randn(flat.shape, generator=generator)
    corner = (row * SIDE + column)[:-1, :-1].reshape(-1)
    faces = torch.stack([corner, corner + SIDE, corner + SIDE + 1], 1)
    faces = torch.cat([faces, torch.stack([corner, corner + SIDE + 1, corner + 1], 1)])
    faces = faces[torch.randperm(len(faces), generator=generator)]  # neighbours meet on different threads
    moved = 1e-3 * torch.randn(flat.shape, generator=generator)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        gradients = []
        for _ in range(25):
            leaf = moved.clone().requires_grad_()
            rotation_term(surface, leaf, torch.zeros_like(leaf), faces).backward()
            gradients.append(leaf.grad)
    finally:
        torch.set_num_threads(threads)
    assert gradients[0].abs().max() > 0
    assert all(torch.equal(gradients[0], other) for other in gradients[1:])


def test_an_output_without_a_folder_is_refused_before_any_work(tmp_path: Path):
    with pytest.raises(ArgumentError, match="output: expected a file in a folder that exists"):
        fit([tmp_path / "no capture"], None, tmp_path / "nowhere" / "x.cap4d")
