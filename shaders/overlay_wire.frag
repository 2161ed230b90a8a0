// The triangles of a mesh of any shape as lines. Corners have the rows and columns (0, 0), (1, 0), (1, 1), so that sides lie
// where rows, columns and diagonals do. No side can be left out of an irregular mesh: where they are dense they fade.
#include "lib/shading.glsl"
#include "lib/grid_lines.glsl"

const float LEAST_SPACING = 9.0;  // px between lines of full strength
const float FAINTEST = 0.12;
const float WIDTH = 0.9, HALO = 2.0;  // px, of either triangle's half of a side
const vec4 LINE = vec4(0.80, 0.97, 1.0, 0.95), DARK = vec4(0.0, 0.08, 0.14, 0.38);  // straight
const float BEHIND = 0.25;  // of what is seen from inside

in vec3 view;
in vec2 grid;

out vec4 premultiplied;

float cover(vec3 coordinates, vec3 change, float width) {
    float row = line_cover(coordinates.x, change.x, 1.0, width);
    float column = line_cover(coordinates.y, change.y, 1.0, width);
    float diagonal = line_cover(coordinates.z, change.z, 1.0, width);
    return max(max(row, column), diagonal);
}

void main() {
    vec3 coordinates = vec3(grid, grid.x - grid.y);
    vec3 change = vec3(change_per_px(coordinates.x), change_per_px(coordinates.y), change_per_px(coordinates.z));
    float spacing = 1.0 / max(max(change.x, change.y), change.z);  // px
    float strength = clamp(spacing / LEAST_SPACING, FAINTEST, 1.0) * (facing() ? 1.0 : BEHIND);
    float dark = DARK.a * cover(coordinates, change, HALO) * strength;
    float light = LINE.a * cover(coordinates, change, WIDTH) * strength;
    premultiplied = vec4(LINE.rgb * light + DARK.rgb * dark * (1.0 - light), light + dark * (1.0 - light));
}
