"""Includes, injected constants, and errors at the place where they are."""

import numpy as np
import pytest
from cap4d.app.shader_source import ShaderError, build_program, read_package_shader, shader_source

FILES = {
    "a.vert": '#include "lib/one.glsl"\n#include "lib/two.glsl"\nvoid main() { gl_Position = vec4(two()); }',
    "a.frag": "out vec4 color;\nvoid main() {\n    color = vec4(HALF);\n}\n",
    "lib/one.glsl": "float one() { return ONE; }\n",
    "lib/two.glsl": '#include "lib/one.glsl"\nfloat two() {\n    return one() + one();\n}\n',
}
CONSTANTS = {"ONE": 1.0, "HALF": 0.5}


def read(name: str, files=FILES) -> str:
    if name not in files:
        raise FileNotFoundError(name)
    return files[name]


def test_a_chunk_is_included_once_and_keeps_its_line_numbers():
    source = shader_source("a.vert", CONSTANTS, read=read)
    assert source.text.count("float one()") == 1
    assert source.files == ("a.vert", "lib/one.glsl", "lib/two.glsl")
    lines = source.text.splitlines()
    assert lines[0] == "#version 410 core"
    assert lines[lines.index("void main() { gl_Position = vec4(two()); }") - 1] == "#line 3 0"
    assert lines[lines.index("float two() {") - 1] == "#line 2 2"


def test_constants_are_the_float32_they_stand_for():
    constants = {"COUNT": 4, "TINY": 1 / 255, "WHOLE": 3.0, "SMALL": 1e-20}
    text = shader_source("a.vert", constants, read=read).text
    assert "#define COUNT 4\n" in text
    literal = text.split("const float TINY = ")[1].split(";")[0]
    assert np.float32(literal) == np.float32(1 / 255)
    assert "const float WHOLE = 3.0;" in text
    assert "const float SMALL = 1e-20;" in text


@pytest.mark.parametrize(
    ("log", "expected"),
    [
        ("2:14(5): error: oh", "lib/two.glsl:14: error: oh"),
        ("1(14) : error C1: oh", "lib/one.glsl:14: error C1: oh"),
        ("ERROR: 0:14: 'x' : oh", "ERROR: a.vert:14: 'x' : oh"),
        ("9:14(5): error: oh", "9:14: error: oh"),
        ("no position", "no position"),
    ],
)
def test_positions_of_every_driver_are_resolved(log, expected):
    assert shader_source("a.vert", read=read).locate(log) == expected


def test_a_missing_file_is_named():
    files = {"b.vert": '#include "lib/three.glsl"'}
    with pytest.raises(ShaderError, match=r"lib/three\.glsl"):
        shader_source("b.vert", read=lambda name: read(name, files))


def test_a_good_program_compiles(ctx):
    assert build_program(ctx, "a", CONSTANTS, read=read)


def test_an_error_in_a_chunk_names_the_chunk_and_its_line(ctx):
    broken = FILES | {"lib/two.glsl": "float two() {\n    float x = 1.0;\n    return nothing;\n}\n"}
    with pytest.raises(ShaderError) as error:
        build_program(ctx, "a", CONSTANTS, read=lambda name: read(name, broken))
    assert "lib/two.glsl:3" in str(error.value)
    assert "nothing" in str(error.value)
    assert "\n" not in str(error.value)


def test_an_error_in_the_fragment_stage_names_its_file(ctx):
    with pytest.raises(ShaderError, match=r"a\.frag:3"):
        build_program(ctx, "a", {"ONE": 1.0}, read=read)


@pytest.mark.parametrize("name", ["project.vert", "splat.vert", "splat.frag", "present.frag", "panel.frag"])
def test_the_installed_shaders_are_found(name):
    assert "void main()" in read_package_shader(name)


def test_every_chunk_says_what_it_reads_defines_and_computes():
    for name in ("rotation", "triangle_frame", "projection", "spherical_harmonics"):
        text = read_package_shader(f"lib/{name}.glsl")
        assert all(f"// {header}:" in text for header in ("Reads", "Defines", "Maths")), name
