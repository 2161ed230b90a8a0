"""Who may import whom: the dependency rules, read from the imports and includes themselves."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CORE_RING = ("rig", "bundle", "player", "drive")
PLAYER_MODULES = {"numpy", "onnxruntime", "safetensors", "moderngl", "glfw", "imgui_bundle", "av"}
LIVE_MODULES = {"miniaudio", "websockets"}  # the extra `live`: imported where they are used
FILE_ROOMS = ("rig", "bundle", "player", "drive", "capture", "track", "export", "avatar", "synth")


def imports(path: Path) -> set[str]:
    """Full names of the modules that a file imports anywhere, lazily or not."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def sources(*rooms: str) -> list[Path]:
    return [p for room in rooms for p in sorted((ROOT / room).rglob("*.py"))]


def roots(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports(path)}


@pytest.mark.parametrize(
    "path", sources(*(f"cap4d/{r}" for r in CORE_RING), "app"), ids=lambda p: str(p.relative_to(ROOT))
)
def test_core_ring_and_app_never_import_torch(path: Path) -> None:
    assert "torch" not in roots(path)


@pytest.mark.parametrize("path", sources("cap4d"), ids=lambda p: str(p.relative_to(ROOT)))
def test_cap4d_never_imports_app(path: Path) -> None:
    assert not {name for name in imports(path) if name == "cap4d.app" or name.startswith("cap4d.app.")}


def test_mmdm_and_avatar_never_meet() -> None:
    for path in sources("cap4d/avatar"):
        assert not {name for name in imports(path) if name.startswith("cap4d.mmdm")}, path
    for path in sources("cap4d/mmdm"):
        assert not {name for name in imports(path) if name.startswith("cap4d.avatar")}, path


def test_player_needs_only_its_light_dependencies() -> None:
    for path in sources("cap4d/player", "app"):
        foreign = roots(path) - set(sys.stdlib_module_names) - PLAYER_MODULES - LIVE_MODULES - {"cap4d"}
        assert not foreign, f"{path}: {foreign}"


@pytest.mark.parametrize("module", ["cap4d", "cap4d.cli", "cap4d.app.main"])
def test_importing_imports_nothing_heavy(module: str) -> None:
    heavy = ("numpy", "torch", "onnxruntime", "scipy", "trimesh")
    code = f"import sys, {module}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_cpp_maths_know_no_python_and_no_gl() -> None:
    for path in sorted((ROOT / "src/cpp").glob("*")):
        if path.name.startswith(("bind_", "bindings", "module")):
            continue
        included = re.findall(r'#include\s*[<"]([^>"]+)', path.read_text())
        assert not [
            name for name in included if "pybind" in name or "Python" in name or name.startswith("GL")
        ], path


def test_no_vague_names() -> None:
    vague = {"utils", "util", "helpers", "common", "misc", "manager"}
    assert not [p for p in sources("cap4d", "app") if p.stem in vague or p.parent.name in vague]
