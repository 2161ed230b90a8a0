// Reads:   QUAT_MIN.
// Defines: quat_to_rotmat, rotmat_to_quat, quat_product.
// Maths:   Hamilton quaternions, wxyz.

// `quat` need not be unit; one without a direction is no rotation.
mat3 quat_to_rotmat(vec4 quat) {
    float largest = max(max(abs(quat.x), abs(quat.y)), max(abs(quat.z), abs(quat.w)));
    vec4 q = largest > QUAT_MIN ? normalize(quat / largest) : vec4(1.0, 0.0, 0.0, 0.0);
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// The best conditioned of Shepperd's four forms (ties: the first). Not normalised; never zero, not even for a matrix
// that is no rotation.
vec4 rotmat_to_quat(mat3 m) {
    vec3 diagonal = vec3(m[0].x, m[1].y, m[2].z);
    float trace = diagonal.x + diagonal.y + diagonal.z;
    float best = max(max(trace, diagonal.x), max(diagonal.y, diagonal.z));
    vec3 skew = vec3(m[1].z - m[2].y, m[2].x - m[0].z, m[0].y - m[1].x);
    vec3 both = vec3(m[1].x + m[0].y, m[2].x + m[0].z, m[2].y + m[1].z);  // xy, xz, yz
    if (best == trace) return vec4(1.0 + trace, skew);
    vec3 own = 1.0 + 2.0 * diagonal - trace;
    if (best == diagonal.x) return vec4(skew.x, own.x, both.x, both.y);
    if (best == diagonal.y) return vec4(skew.y, both.x, own.y, both.z);
    return vec4(skew.z, both.y, both.z, own.z);
}

vec4 quat_product(vec4 a, vec4 b) {
    return vec4(a.x * b.x - dot(a.yzw, b.yzw), a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}
