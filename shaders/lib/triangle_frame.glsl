// Reads:   SAFE_NORM2.
// Defines: TriangleFrame, triangle_frame.
// Maths:   GaussianAvatars (Qian et al. 2024, sec. 3.2) with CAP4D's face scale (fact 27), as in bind.cpp: a0 along the
//          first edge, a1 the normal, a2 = -(a1 x a0); the size is the mean of the first edge's length and the height
//          above it. A triangle without area gets some rotation and its own, possibly zero, size.

struct TriangleFrame {
    vec3 centre;
    mat3 rotation;
    float size;
};

vec3 safe_normalize(vec3 v) {
    return v / sqrt(max(dot(v, v), SAFE_NORM2));
}

TriangleFrame triangle_frame(vec3 v0, vec3 v1, vec3 v2) {
    vec3 edge = v1 - v0, side = v2 - v0;
    vec3 a0 = safe_normalize(edge);
    vec3 a1 = safe_normalize(cross(a0, side));
    vec3 a2 = -cross(a1, a0);
    float size = 0.5 * (sqrt(max(dot(edge, edge), SAFE_NORM2)) + abs(dot(a2, side)));
    return TriangleFrame((v0 + v1 + v2) / 3.0, mat3(a0, a1, a2), size);
}
