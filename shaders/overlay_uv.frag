// The texture's coordinates on the surface: a checkerboard whose colour says where in the texture one is.
#include "lib/shading.glsl"
#include "lib/grid_lines.glsl"

const float SQUARES = 16.0;  // a side of the texture
const float OPACITY = 0.72;
const vec2 HUES = vec2(0.62, 0.0);   // u from blue over green and yellow to red
const vec2 LIGHT = vec2(0.8, 1.0);  // v from dark to light

uniform float grid_size;  // pixels a side

in vec3 view;
in vec2 grid;

out vec4 premultiplied;

// Full colours of a hue, 0 to 1.
vec3 rainbow(float hue) {
    return clamp(abs(mod(6.0 * hue + vec3(0.0, 4.0, 2.0), 6.0) - 3.0) - 1.0, 0.0, 1.0);
}

void main() {
    vec2 uv = vec2(1.0 - (grid.y + 0.5) / grid_size, (grid.x + 0.5) / grid_size);
    vec2 square = floor(uv * SQUARES);
    bool light = mod(square.x + square.y, 2.0) > 0.5;
    vec3 hue = rainbow(mix(HUES.x, HUES.y, uv.x));
    vec3 color = (light ? mix(hue, vec3(1.0), 0.7) : 0.9 * hue) * mix(LIGHT.x, LIGHT.y, 1.0 - uv.y);
    vec2 change = vec2(change_per_px(uv.x), change_per_px(uv.y));
    float line = max(line_cover(uv.x, change.x, 1.0 / SQUARES, 1.0), line_cover(uv.y, change.y, 1.0 / SQUARES, 1.0));
    float quarter = max(line_cover(uv.x, change.x, 0.25, 2.2), line_cover(uv.y, change.y, 0.25, 2.2));
    color = mix(color, vec3(0.08, 0.10, 0.14), max(0.55 * line, 0.9 * quarter));
    color *= (facing() ? 0.55 : 0.2) + 0.45 * headlight(view);
    premultiplied = vec4(color, 1.0) * OPACITY;
}
