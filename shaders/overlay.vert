// The grid's surface where the splats are: the same camera, and row 0 of the framebuffer is the image's top row.
#include "lib/camera.glsl"

in vec3 position;   // m, in the world
in vec2 pixel;      // row and column in the UV grid
in float value;     // what the colours of an overlay mean, in its unit

out vec3 view;      // m, in the camera
out vec2 grid;
out float amount;

invariant gl_Position;  // overlays lie on one another: their depths are compared

void main() {
    view = (viewmat * vec4(position, 1.0)).xyz;
    grid = pixel;
    amount = value;
    vec2 pixels = intrinsics.xy * view.xy + intrinsics.zw * view.z;  // times the depth
    float depth = (FAR + NEAR) / (FAR - NEAR) * view.z - 2.0 * FAR * NEAR / (FAR - NEAR);
    gl_Position = vec4(2.0 * pixels / image_size - view.z, depth, view.z);
}
