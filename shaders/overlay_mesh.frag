// The grid's triangles as lines. Where they are too dense on the screen, every second row, column and diagonal is left
// out, again and again: what remains are edges of the mesh, and their triangles look alike at any distance.
#include "lib/shading.glsl"
#include "lib/grid_lines.glsl"

const float LEAST_SPACING = 9.0;  // px between lines
const float WIDTH = 1.1, HALO = 2.6;  // px
const vec4 LINE = vec4(0.80, 0.97, 1.0, 0.95), DARK = vec4(0.0, 0.08, 0.14, 0.38);  // straight
const float BEHIND = 0.25;  // of what is seen from inside

in vec3 view;
in vec2 grid;

out vec4 premultiplied;

// Rows, columns and diagonals.
float cover(vec3 coordinates, vec3 change, float spacing, float width) {
    float row = line_cover(coordinates.x, change.x, spacing, width);
    float column = line_cover(coordinates.y, change.y, spacing, width);
    float diagonal = line_cover(coordinates.z, change.z, spacing, width);
    return max(max(row, column), diagonal);
}

void main() {
    vec3 coordinates = vec3(grid, grid.x - grid.y);
    vec3 change = vec3(change_per_px(coordinates.x), change_per_px(coordinates.y), change_per_px(coordinates.z));
    float level = max(0.0, log2(LEAST_SPACING * max(change.x, change.y)));
    float fine = exp2(floor(level)), fade = smoothstep(0.3, 1.0, fract(level));
    float line = mix(cover(coordinates, change, fine, WIDTH), cover(coordinates, change, 2.0 * fine, WIDTH), fade);
    float halo = mix(cover(coordinates, change, fine, HALO), cover(coordinates, change, 2.0 * fine, HALO), fade);
    float seen = facing() ? 1.0 : BEHIND;
    float dark = DARK.a * halo * seen, light = LINE.a * line * seen;
    premultiplied = vec4(LINE.rgb * light + DARK.rgb * dark * (1.0 - light), light + dark * (1.0 - light));
}
