"""A real browser without a display, driven through its DevTools protocol."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars"),
)
START_SECONDS = 60.0


def chromium() -> str | None:
    """Where it is, if it is."""
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Page:
    """One tab."""

    def __init__(self, socket, session: str) -> None:
        self._socket, self._session, self._number = socket, session, 0
        self.errors: list[str] = []  # what the page's scripts threw, and what the browser refused them
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """One command of the protocol."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params, "sessionId": self._session}
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv(timeout=START_SECONDS))
            self._note(answer)
            if answer.get("id") == self._number and answer.get("sessionId") == self._session:
                assert "error" not in answer, answer
                return answer["result"]

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression; promises are waited for."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait_for(self, expression: str, *, seconds: float = 30.0) -> Any:
        """Its value, as soon as it is true."""
        until = time.monotonic() + seconds
        while not (value := self.evaluate(expression)):
            assert time.monotonic() < until, f"not within {seconds:g} s: {expression}; {self.errors}"
            time.sleep(0.05)
        return value

    def goto(self, url: str) -> None:
        """Opens an address, and waits until it is loaded."""
        self.call("Page.navigate", url=url)
        self.wait_for("location.href !== 'about:blank' && document.readyState === 'complete'")

    def resize(self, width: int, height: int, *, dark: bool = False) -> None:
        """The tab's size, and its colours."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """`mousePressed`, `mouseMoved`, `mouseReleased` or `mouseWheel`."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(self, start: tuple[float, float], end: tuple[float, float], *, steps: int = 8) -> None:
        """With the left button."""
        self.mouse("mousePressed", *start, button="left", buttons=1, clickCount=1)
        for i in range(1, steps + 1):
            at = [a + (b - a) * i / steps for a, b in zip(start, end, strict=True)]
            self.mouse("mouseMoved", *at, button="left", buttons=1)
        self.mouse("mouseReleased", *end, button="left", buttons=0, clickCount=1)

    def screenshot(self, path: Path) -> None:
        """A PNG of the tab."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def _note(self, answer: dict[str, Any]) -> None:
        params = answer.get("params", {})
        if answer.get("method") == "Runtime.exceptionThrown":
            self.errors.append(params["exceptionDetails"].get("exception", {}).get("description", "?"))
        if answer.get("method") == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"]["text"])


@contextmanager
def browser(folder: Path) -> Iterator[Page]:
    """A fresh browser with one empty tab; `folder` is its profile."""
    from websockets.sync.client import connect

    command = [chromium(), *FLAGS, f"--user-data-dir={folder}", "--remote-debugging-port=0", "about:blank"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        address = _address(folder, process)
        with connect(address, max_size=None, compression=None, proxy=None) as socket:
            yield Page(socket, _attach(socket))
            socket.send(json.dumps({"id": 0, "method": "Browser.close"}))
            process.wait(START_SECONDS)
    finally:
        process.kill()
        process.wait()


def _address(folder: Path, process: subprocess.Popen) -> str:
    """Where the browser listens, as it writes into its profile: a port, and a path on the next line."""
    file, until = folder / "DevToolsActivePort", time.monotonic() + START_SECONDS
    while not file.is_file() or len(lines := file.read_text().split()) < 2:
        assert process.poll() is None, f"Chromium ended with code {process.returncode}"
        assert time.monotonic() < until, f"Chromium did not listen within {START_SECONDS:g} s"
        time.sleep(0.05)
    return f"ws://127.0.0.1:{lines[0]}{lines[1]}"


def _attach(socket) -> str:
    target = _ask(socket, "Target.createTarget", url="about:blank")["targetId"]
    return _ask(socket, "Target.attachToTarget", targetId=target, flatten=True)["sessionId"]


def _ask(socket, method: str, **params: Any) -> dict[str, Any]:
    socket.send(json.dumps({"id": -1, "method": method, "params": params}))
    while (answer := json.loads(socket.recv(timeout=START_SECONDS))).get("id") != -1:
        pass
    return answer["result"]
