"""The README's Python runs as it stands: its files are there, and a sender is."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import av
import numpy as np
import pytest
from tiny_bundle import EXPRESSIONS, RIG_NAME, tiny_bundle

from cap4d.bundle import write_bundle
from cap4d.drive.packet import Packet
from cap4d.drive.wire import format_packet

README = Path(__file__).parents[2] / "README.md"
T = 5


@pytest.fixture
def blocks(tmp_path: Path, monkeypatch) -> list[str]:
    """The page's Python, in a folder that holds what it speaks of."""
    monkeypatch.chdir(tmp_path)
    write_bundle(tiny_bundle(), tmp_path / "me.cap4d")
    np.save("expressions.npy", np.linspace(0, 1, T * len(EXPRESSIONS), dtype=np.float32).reshape(T, -1))
    return re.findall(r"```python\n(.*?)```", README.read_text("utf-8"), re.DOTALL)


def test_an_array_of_expressions_becomes_a_video(blocks: list[str]) -> None:
    names: dict = {"expr": None}
    exec(compile(blocks[0], README.name, "exec"), names)
    with av.open("out.mp4") as video:
        assert sum(1 for _ in video.decode(video=0)) == T
    assert names["gaussians"].means.shape[1] == 3


def test_a_socket_becomes_pictures_in_a_callback(blocks: list[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    lines = b"".join(
        format_packet(Packet(n / 30, RIG_NAME, expr=np.float32([1, 0, 0, 0, 0]))) for n in range(20)
    )
    pictures: list[np.ndarray] = []
    senders: list[socket.socket] = []

    def on_picture(image: np.ndarray) -> bool:
        if not senders:
            senders.append(socket.create_connection(("127.0.0.1", port)))
            senders[0].sendall(lines)
        pictures.append(image.copy())
        return len(pictures) < 2000 and np.array_equal(image, pictures[0])

    code = compile(blocks[1].replace('"tcp://:9000"', f'"tcp://:{port}"'), README.name, "exec")
    exec(code, {"on_picture": on_picture})
    senders[0].close()
    assert not np.array_equal(pictures[-1], pictures[0])  # the jaw opened
