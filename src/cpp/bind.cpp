#include "bind.h"

#include <algorithm>
#include <cmath>

#include "constants.h"
#include "parallel.h"
#include "tiles.h"

namespace cap4d {
namespace {

constexpr std::size_t kGrain = 2048;

struct Vec3 {
  float x, y, z;
};
Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
Vec3 operator*(float s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
float dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
Vec3 safe_normalize(Vec3 a) { return 1.0f / std::sqrt(std::max(dot(a, a), kSafeNorm2)) * a; }

struct Frame {
  float rotmat[9];  // columns: edge, normal, their cross product negated
  float quat[4];
  float centre[3];
  float size;
};

// The best conditioned of Shepperd's four forms, in the order of rotmat_to_quat of rotation.py. A degenerate frame (not a rotation)
// still gives a unit quaternion.
void rotmat_to_quat(const float* r, float* q) {
  const float trace = r[0] + r[4] + r[8];
  const float scores[4] = {trace, r[0], r[4], r[8]};
  switch (std::max_element(scores, scores + 4) - scores) {
    case 0: q[0] = 1 + trace, q[1] = r[7] - r[5], q[2] = r[2] - r[6], q[3] = r[3] - r[1]; break;
    case 1: q[0] = r[7] - r[5], q[1] = 1 + 2 * r[0] - trace, q[2] = r[1] + r[3], q[3] = r[2] + r[6]; break;
    case 2: q[0] = r[2] - r[6], q[1] = r[1] + r[3], q[2] = 1 + 2 * r[4] - trace, q[3] = r[5] + r[7]; break;
    default: q[0] = r[3] - r[1], q[1] = r[2] + r[6], q[2] = r[5] + r[7], q[3] = 1 + 2 * r[8] - trace;
  }
  const float inverse = 1.0f / std::sqrt(std::max(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3], kSafeNorm2));
  for (int i = 0; i < 4; ++i) q[i] *= inverse;
}

Frame triangle_frame(const float* vertices, const std::int32_t* face) {
  const auto at = [&](int i) { return Vec3{vertices[3 * face[i]], vertices[3 * face[i] + 1], vertices[3 * face[i] + 2]}; };
  const Vec3 v0 = at(0), v1 = at(1), v2 = at(2), edge = v1 - v0, side = v2 - v0;
  const Vec3 a0 = safe_normalize(edge), a1 = safe_normalize(cross(a0, side)), a2 = -1.0f * cross(a1, a0);
  Frame f{};
  const Vec3 columns[3] = {a0, a1, a2};
  for (int j = 0; j < 3; ++j) f.rotmat[j] = columns[j].x, f.rotmat[3 + j] = columns[j].y, f.rotmat[6 + j] = columns[j].z;
  rotmat_to_quat(f.rotmat, f.quat);
  f.centre[0] = (v0.x + v1.x + v2.x) / 3, f.centre[1] = (v0.y + v1.y + v2.y) / 3, f.centre[2] = (v0.z + v1.z + v2.z) / 3;
  f.size = 0.5f * (std::sqrt(std::max(dot(edge, edge), kSafeNorm2)) + std::abs(dot(a2, side)));
  return f;
}

void bind_one(const Frame& f, const float* mean, const float* quat, const float* log_scale, float* out_mean, float* out_quat, float* out_scale) {
  for (int i = 0; i < 3; ++i) {
    const float* r = f.rotmat + 3 * i;
    out_mean[i] = (r[0] * mean[0] + r[1] * mean[1] + r[2] * mean[2]) * f.size + f.centre[i];
    out_scale[i] = std::exp(log_scale[i]) * f.size;
  }
  const float norm = std::sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]);
  const float inverse = 1.0f / std::max(norm, 1e-10f);
  const float w = quat[0] * inverse, x = quat[1] * inverse, y = quat[2] * inverse, z = quat[3] * inverse;
  const float* q = f.quat;
  out_quat[0] = q[0] * w - q[1] * x - q[2] * y - q[3] * z;
  out_quat[1] = q[0] * x + q[1] * w + q[2] * z - q[3] * y;
  out_quat[2] = q[0] * y - q[1] * z + q[2] * w + q[3] * x;
  out_quat[3] = q[0] * z + q[1] * y - q[2] * x + q[3] * w;
}

}  // namespace

void bind(const float* vertices, const BoundGaussians& bound, int threads, float* means, float* quats, float* scales) {
  auto frames = make_buffer<Frame>(bound.faces_count);
  parallel_for(bound.faces_count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) frames[i] = triangle_frame(vertices, bound.faces + 3 * i);
  });
  parallel_for(bound.count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i)
      bind_one(frames[bound.binding[i]], bound.means + 3 * i, bound.quats + 4 * i, bound.log_scales + 3 * i, means + 3 * i, quats + 4 * i,
               scales + 3 * i);
  });
}

}  // namespace cap4d
