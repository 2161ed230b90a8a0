// The Gaussian's premultiplied colour at this pixel; blending composites the quads back to front.

flat in vec2 centre;
flat in vec3 inverse_covariance;
flat in vec4 splat;

out vec4 premultiplied;

void main() {
    vec2 d = gl_FragCoord.xy - centre;
    vec3 c = inverse_covariance;
    float power = 0.5 * (c.x * d.x * d.x + c.z * d.y * d.y) + c.y * d.x * d.y;
    float alpha = min(ALPHA_MAX, splat.a * exp(-power));
    if (power < 0.0 || alpha < ALPHA_MIN) discard;
    premultiplied = vec4(splat.rgb * alpha, alpha);
}
