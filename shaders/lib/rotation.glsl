// Reads:   QUAT_MIN.
// Defines: quat_to_rotmat.
// Maths:   Hamilton quaternions, wxyz; need not be unit. One without a direction is no rotation.

mat3 quat_to_rotmat(vec4 quat) {
    float largest = max(max(abs(quat.x), abs(quat.y)), max(abs(quat.z), abs(quat.w)));
    vec4 q = largest < QUAT_MIN ? vec4(1.0, 0.0, 0.0, 0.0) : normalize(quat / largest);
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}
