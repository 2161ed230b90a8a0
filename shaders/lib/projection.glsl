// Reads:   LOW_PASS, JACOBIAN_MARGIN.
// Defines: Pinhole, Footprint, project.
// Maths:   EWA splatting, Zwicker et al. 2002, eq. 31, as in project.h: the perspective's Jacobian at the mean carries
//          the covariance to the image. The Jacobian is taken at most JACOBIAN_MARGIN half fields of view outside the
//          image, beyond which the linear approximation blows up; LOW_PASS px^2 keeps every splat as wide as a pixel.

struct Pinhole {
    vec2 focal;   // px
    vec2 centre;  // px
    vec2 size;    // px
};

struct Footprint {
    vec2 mean2d;        // px
    vec3 covariance;    // xx, xy, yy with the low-pass, px^2
    float determinant;  // of the covariance
};

// `mean` in the camera, m; the columns of `axes` are the Gaussian's principal axes in the camera, one sigma long, m.
Footprint project(vec3 mean, mat3 axes, Pinhole pinhole) {
    vec2 margin = JACOBIAN_MARGIN * 0.5 * pinhole.size / pinhole.focal;
    vec2 low = -pinhole.centre / pinhole.focal - margin;
    vec2 high = (pinhole.size - pinhole.centre) / pinhole.focal + margin;
    vec2 ratio = mean.xy / mean.z;
    vec2 clamped = clamp(ratio, low, high);
    vec2 scale = pinhole.focal / mean.z;
    vec3 m0 = vec3(scale.x, 0.0, -scale.x * clamped.x) * axes;  // the covariance is m m^T
    vec3 m1 = vec3(0.0, scale.y, -scale.y * clamped.y) * axes;
    vec3 covariance = vec3(dot(m0, m0), dot(m0, m1), dot(m1, m1));
    // det(m m^T) as a sum of squares (Cauchy-Binet): xx yy - xy^2 would cancel for needles.
    vec3 minors = cross(m0, m1);
    float determinant = dot(minors, minors) + LOW_PASS * (covariance.x + covariance.z) + LOW_PASS * LOW_PASS;
    return Footprint(ratio * pinhole.focal + pinhole.centre, covariance + vec3(LOW_PASS, 0.0, LOW_PASS), determinant);
}
