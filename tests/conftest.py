"""Fixtures that many tests need."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared" / "data"

# A shell's background jobs ignore Ctrl-C and hand that down: what is tested under one would, too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Benches run only when asked for: `pytest -m bench`."""
    if "bench" in (config.option.markexpr or ""):
        return
    skip = pytest.mark.skip(reason="a bench; run with `pytest -m bench`")
    for item in items:
        if item.get_closest_marker("bench"):
            item.add_marker(skip)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real test data beside the checkout; tests that need it skip where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("no ../shared/data beside the checkout")
    return SHARED


@pytest.fixture(scope="session")
def builtin_rig():
    """The built-in head, built once."""
    from cap4d.rig.builtin import build_head

    return build_head()


@pytest.fixture(scope="module")
def ctx():
    """An OpenGL context without a window; tests that need it skip where there is none."""
    from cap4d.app.gl_context import GlUnavailableError, headless_context

    try:
        context = headless_context()
    except GlUnavailableError as error:
        pytest.skip(str(error))
    yield context
    context.gc()
    context.release()


@pytest.fixture(scope="module")
def served():
    """A page that is served over loopback."""
    from served_page import serving

    with serving() as found:
        yield found


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """tiny.cap4d in the current folder, which is the test's own."""
    from tiny_bundle import tiny_bundle

    from cap4d.bundle import write_bundle

    monkeypatch.chdir(tmp_path)
    write_bundle(tiny_bundle(network=False), "tiny.cap4d")
    return tmp_path / "tiny.cap4d"
