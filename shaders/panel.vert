// Dear ImGui's triangles; positions in window units, y down.

uniform vec4 display;  // left, top, width, height

in vec2 position;
in vec2 uv;
in vec4 color;

out vec2 texel;
out vec4 tint;

void main() {
    vec2 unit = (position - display.xy) / display.zw;
    texel = uv;
    tint = color;
    gl_Position = vec4(2.0 * unit.x - 1.0, 1.0 - 2.0 * unit.y, 0.0, 1.0);
}
