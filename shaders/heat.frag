// Numbers of Gaussians as colours.
#include "lib/color_map.glsl"

const float OPACITY = 0.94;

uniform sampler2D counts;
uniform float limit;  // the number that the last colour stands for

in vec2 uv;
out vec4 premultiplied;

void main() {
    float count = texture(counts, uv).r;
    premultiplied = count > 0.0 ? vec4(color_of(count / limit), 1.0) * OPACITY : vec4(0.0);
}
