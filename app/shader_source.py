"""GLSL from package data to programs: includes, constants, and errors that name the chunk and its line."""

from __future__ import annotations

import importlib.resources
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import moderngl
import numpy as np

from cap4d.errors import Cap4dError

VERSION = "#version 410 core\n"  # macOS stops here
Constant = bool | int | float | Sequence[float]
Reader = Callable[[str], str]

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
# Where drivers put positions: Mesa "3:14(5): error", NVIDIA "3(14) : error", Apple and ANGLE "ERROR: 3:14:".
_POSITION = re.compile(
    r"^(?P<before>(?:ERROR|WARNING): )?(?P<file>\d+)(?::(?P<a>\d+)(?:\(\d+\))?|\((?P<b>\d+)\)\s?): ?"
)


class ShaderError(Cap4dError):
    """A shader did not compile or link; the text names file and line of the chunk."""


@dataclass(frozen=True)
class ShaderSource:
    """A stage ready for the compiler: its text, and the files behind the numbers of its `#line`s."""

    text: str
    files: tuple[str, ...]

    def locate(self, log: str) -> str:
        """The driver's log with `file:line:` where the driver wrote numbers."""
        return "\n".join(_POSITION.sub(self._name, line) for line in log.splitlines())

    def _name(self, match: re.Match[str]) -> str:
        number = int(match["file"])
        file = self.files[number] if number < len(self.files) else match["file"]
        return f"{match['before'] or ''}{file}:{match['a'] or match['b']}: "


def read_package_shader(name: str) -> str:
    """The text of `name` ("splat.frag", "lib/rotation.glsl") among the installed shaders."""
    return importlib.resources.files("cap4d.shaders").joinpath(*name.split("/")).read_text("utf-8")


def shader_source(
    name: str, constants: Mapping[str, Constant] | None = None, *, read: Reader = read_package_shader
) -> ShaderSource:
    """Loads a stage: version, constants, then the file, each `#include "..."` in it replaced once.

    Raises:
        ShaderError: A file is missing.
    """
    files: list[str] = []
    body = _expanded(name, files, read)
    prelude = "".join(_declaration(key, value) for key, value in (constants or {}).items())
    return ShaderSource(f"{VERSION}{prelude}{body}", tuple(files))


def build_program(
    ctx: moderngl.Context,
    name: str,
    constants: Mapping[str, Constant] | None = None,
    *,
    vertex: str | None = None,
    varyings: Sequence[str] = (),
    read: Reader = read_package_shader,
) -> moderngl.Program:
    """Compiles `name.vert` with `name.frag`; when there are `varyings`, alone for transform feedback.

    `vertex` names another vertex stage: one that several programs share.

    Raises:
        ShaderError: With the driver's message, positions as `file:line`.
    """
    sources = {"vertex_shader": shader_source(f"{vertex or name}.vert", constants, read=read)}
    if not varyings:
        sources["fragment_shader"] = shader_source(f"{name}.frag", constants, read=read)
    try:
        texts = {stage: source.text for stage, source in sources.items()}
        return ctx.program(**texts, varyings=tuple(varyings))
    except moderngl.Error as error:
        raise ShaderError(_explained(name, str(error), sources)) from error


def _expanded(name: str, files: list[str], read: Reader) -> str:
    number = len(files)
    files.append(name)
    try:
        lines = read(name).splitlines()
    except OSError as error:
        raise ShaderError(f"{name}: no such shader among the installed ones") from error
    text = [f"#line 1 {number}"]
    for count, line in enumerate(lines, 1):
        include = _INCLUDE.match(line)
        if include and include[1] not in files:
            text.append(_expanded(include[1], files, read))
        text.append(f"#line {count + 1} {number}" if include else line)
    return "\n".join(text) + "\n"


def _declaration(name: str, value: Constant) -> str:
    """A constant in GLSL. Integers become macros, so that `#if` can read them."""
    if isinstance(value, int):
        return f"#define {name} {int(value)}\n"
    if isinstance(value, float):
        return f"const float {name} = {_literal(value)};\n"
    return f"const float {name}[{len(value)}] = float[]({', '.join(map(_literal, value))});\n"


def _literal(value: float) -> str:
    """The shortest decimal that is the same float32."""
    text = str(np.float32(value))
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def _explained(name: str, message: str, sources: Mapping[str, ShaderSource]) -> str:
    """moderngl's message (`GLSL Compiler failed`, stage, ruler, log) on one line, positions resolved."""
    stage = next((source for key, source in sources.items() if key in message), sources["vertex_shader"])
    log = [line for line in stage.locate(message).splitlines() if line.strip() and set(line.strip()) != {"="}]
    return f"shader {name}: " + "; ".join(line.strip() for line in log if line.strip() not in sources)
