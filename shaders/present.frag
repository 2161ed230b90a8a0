// A premultiplied picture over a background.

const int COLOUR = 1, CHECKERBOARD = 2, IMAGE = 3;  // kind 0: none, the result stays premultiplied

uniform sampler2D picture;
uniform sampler2D behind;   // an image
uniform int kind;
uniform vec3 background;    // sRGB
uniform vec2 size;          // of the picture, px
uniform vec2 cover;         // the share of the image that is seen

in vec2 uv;
out vec4 color;

vec3 behind_at(vec2 at) {
    if (kind == CHECKERBOARD) {
        vec2 square = floor(at * size / CHECK_PX);
        return vec3(CHECK_GREYS[int(mod(square.x + square.y, 2.0))]);
    }
    return kind == IMAGE ? texture(behind, 0.5 + (at - 0.5) * cover).rgb : background;
}

void main() {
    vec4 premultiplied = texture(picture, uv);
    if (kind == 0) {
        color = premultiplied;
        return;
    }
    color = vec4(premultiplied.rgb + (1.0 - premultiplied.a) * behind_at(uv), 1.0);
}
