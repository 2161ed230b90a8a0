// Reads:   LOW_PASS, JACOBIAN_MARGIN.
// Defines: Pinhole, covariance_3d, covariance_2d.
// Maths:   EWA splatting, Zwicker et al. 2002, eq. 31: the perspective's Jacobian at the mean carries the covariance to
//          the image. The Jacobian is taken at most JACOBIAN_MARGIN half fields of view outside the image, beyond which the
//          linear approximation blows up; LOW_PASS px^2 is the low-pass that keeps every splat as wide as a pixel.

struct Pinhole {
    vec2 focal;      // px
    vec2 centre;     // px
    vec2 size;       // px
};

mat3 covariance_3d(mat3 rotation, vec3 scale) {
    mat3 M = mat3(rotation[0] * scale.x, rotation[1] * scale.y, rotation[2] * scale.z);
    return M * transpose(M);
}

// The image-plane covariance (xx, xy, yy) px^2 of a view-space covariance at view-space `mean`.
vec3 covariance_2d(mat3 covariance, vec3 mean, Pinhole pinhole) {
    vec2 margin = JACOBIAN_MARGIN * 0.5 * pinhole.size / pinhole.focal;
    vec2 low = -pinhole.centre / pinhole.focal - margin;
    vec2 high = (pinhole.size - pinhole.centre) / pinhole.focal + margin;
    vec2 slope = clamp(mean.xy / mean.z, low, high);
    vec2 f = pinhole.focal / mean.z;
    vec3 jx = vec3(f.x, 0.0, -f.x * slope.x);
    vec3 jy = vec3(0.0, f.y, -f.y * slope.y);
    vec3 cx = covariance * jx;
    vec3 cy = covariance * jy;
    return vec3(dot(jx, cx) + LOW_PASS, dot(jx, cy), dot(jy, cy) + LOW_PASS);
}
