// A value on the surface, as a colour.
#include "lib/shading.glsl"
#include "lib/color_map.glsl"

const float OPACITY = 0.88;

uniform float limit;  // the value of the last colour

in vec3 view;
in float amount;

out vec4 premultiplied;

void main() {
    vec3 color = color_of(amount / limit);
    color *= (facing() ? 0.68 : 0.3) + 0.32 * headlight(view);
    premultiplied = vec4(color, 1.0) * OPACITY;
}
