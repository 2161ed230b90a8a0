// A premultiplied picture over a plain background.

uniform sampler2D picture;
uniform vec3 background;

in vec2 uv;
out vec4 color;

void main() {
    vec4 premultiplied = texture(picture, uv);
    color = vec4(premultiplied.rgb + (1.0 - premultiplied.a) * background, 1.0);
}
