// One for every pixel that a Gaussian reaches, as splat.frag decides it; blending adds them up.

flat in vec2 centre;
flat in vec3 completed_square;
flat in vec4 splat;

out float count;

void main() {
    vec2 d = gl_FragCoord.xy - centre;
    vec3 c = completed_square;
    float u = d.y - c.z * d.x;
    if (splat.a * exp(-0.5 * (c.x * d.x * d.x + c.y * u * u)) < ALPHA_MIN) discard;
    count = 1.0;
}
