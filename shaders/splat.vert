// One quad per projected Gaussian, as large as its visible ellipse. Row 0 of the framebuffer is the image's top row.

uniform vec2 image_size;  // px

in vec2 mean2d;
in vec3 conic;
in vec4 color_opacity;
in vec4 axes;

flat out vec2 centre;
flat out vec3 completed_square;
flat out vec4 splat;

void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
    vec2 pixel = mean2d + corner.x * axes.xy + corner.y * axes.zw;
    centre = mean2d;
    completed_square = conic;
    splat = color_opacity;
    gl_Position = axes == vec4(0.0) ? vec4(2.0, 2.0, 2.0, 1.0) : vec4(pixel / image_size * 2.0 - 1.0, 0.0, 1.0);
}
