// One triangle that covers the viewport.

uniform vec2 flip;  // (1, 1): row 0 of the image at the framebuffer's row 0; (1, -1): the image upright in a window

out vec2 uv;

void main() {
    vec2 corner = vec2((gl_VertexID & 1) * 4 - 1, (gl_VertexID >> 1) * 4 - 1);
    uv = 0.5 + 0.5 * corner * flip;
    gl_Position = vec4(corner, 0.0, 1.0);
}
