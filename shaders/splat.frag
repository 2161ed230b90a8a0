// The Gaussian's premultiplied colour at this pixel; blending composites the quads back to front.

flat in vec2 centre;
flat in vec3 completed_square;
flat in vec4 splat;

out vec4 premultiplied;

void main() {
    vec2 d = gl_FragCoord.xy - centre;
    // d' covariance^-1 d as a sum of squares: multiplied out it cancels along needles.
    vec3 c = completed_square;
    float u = d.y - c.z * d.x;
    float alpha = min(ALPHA_MAX, splat.a * exp(-0.5 * (c.x * d.x * d.x + c.y * u * u)));
    if (alpha < ALPHA_MIN) discard;
    premultiplied = vec4(splat.rgb * alpha, alpha);
}
