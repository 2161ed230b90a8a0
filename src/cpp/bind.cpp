#include "bind.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "constants.h"
#include "parallel.h"
#include "scratch.h"

namespace cap4d {
namespace {

constexpr std::size_t kGrain = 2048;
constexpr float kMinExtent = 1e-7f;  // m; a triangle whose edge or height is shorter passes no gradient to its frame

struct Vec3 {
  float x, y, z;
};
Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
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

void upright(const float* axes, float* rotmat) {
  float q[4];
  rotmat_to_quat(axes, q);
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  const float r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
                      2 * (y * z - w * x),     2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
  std::copy_n(r, 9, rotmat);
}

// backward ------------------------------------------------------------------------------------------------------------------

namespace {

// Rows grouped by a key in [0, keys): those of key k are items[starts[k]..starts[k + 1]), in ascending order. So sums over a group
// have one order, whatever the number of threads.
struct Groups {
  std::vector<std::size_t> starts, items;
};

template <class Key>
Groups group_by(std::size_t count, std::size_t keys, const Key& key_of) {
  Groups g{std::vector<std::size_t>(keys + 1), std::vector<std::size_t>(count)};
  for (std::size_t i = 0; i < count; ++i) ++g.starts[key_of(i) + 1];
  for (std::size_t k = 0; k < keys; ++k) g.starts[k + 1] += g.starts[k];
  std::vector<std::size_t> next(g.starts.begin(), g.starts.end() - 1);
  for (std::size_t i = 0; i < count; ++i) g.items[next[key_of(i)]++] = i;
  return g;
}

struct FrameGradient {
  float turn[3];  // dL/d(omega), the frame rotated by omega about the world's axes
  float centre[3];
  float size;
};

// out = q_face (x) u with u = quat / |quat|: to the quaternion, and to the turn of the face, dq = (0, omega) (x) q / 2.
void bind_quat_bwd(const float* face, const float* quat, const float* v, float* v_quat, float* turn) {
  const float norm = std::max(std::sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]), 1e-10f);
  const float u[4] = {quat[0] / norm, quat[1] / norm, quat[2] / norm, quat[3] / norm};
  const float* q = face;
  const float v_u[4] = {q[0] * v[0] + q[1] * v[1] + q[2] * v[2] + q[3] * v[3], q[0] * v[1] - q[1] * v[0] - q[2] * v[3] + q[3] * v[2],
                        q[0] * v[2] + q[1] * v[3] - q[2] * v[0] - q[3] * v[1], q[0] * v[3] - q[1] * v[2] + q[2] * v[1] - q[3] * v[0]};
  const float along = u[0] * v_u[0] + u[1] * v_u[1] + u[2] * v_u[2] + u[3] * v_u[3];
  for (int i = 0; i < 4; ++i) v_quat[i] = (v_u[i] - u[i] * along) / norm;
  const float o[4] = {q[0] * u[0] - q[1] * u[1] - q[2] * u[2] - q[3] * u[3], q[0] * u[1] + q[1] * u[0] + q[2] * u[3] - q[3] * u[2],
                      q[0] * u[2] - q[1] * u[3] + q[2] * u[0] + q[3] * u[1], q[0] * u[3] + q[1] * u[2] - q[2] * u[1] + q[3] * u[0]};
  turn[0] += 0.5f * (-o[1] * v[0] + o[0] * v[1] - o[3] * v[2] + o[2] * v[3]);
  turn[1] += 0.5f * (-o[2] * v[0] + o[3] * v[1] + o[0] * v[2] - o[1] * v[3]);
  turn[2] += 0.5f * (-o[3] * v[0] - o[2] * v[1] + o[1] * v[2] + o[0] * v[3]);
}

void bind_one_bwd(const Frame& f, const BoundGaussians& bound, const BindGradients& g, std::size_t i, FrameGradient& v_frame) {
  const float *x = bound.means + 3 * i, *v = g.v_means + 3 * i;
  float arm[3];  // R x
  for (int r = 0; r < 3; ++r) arm[r] = f.rotmat[3 * r] * x[0] + f.rotmat[3 * r + 1] * x[1] + f.rotmat[3 * r + 2] * x[2];
  for (int c = 0; c < 3; ++c) g.v_local_means[3 * i + c] = f.size * (f.rotmat[c] * v[0] + f.rotmat[3 + c] * v[1] + f.rotmat[6 + c] * v[2]);
  v_frame.turn[0] += f.size * (arm[1] * v[2] - arm[2] * v[1]);
  v_frame.turn[1] += f.size * (arm[2] * v[0] - arm[0] * v[2]);
  v_frame.turn[2] += f.size * (arm[0] * v[1] - arm[1] * v[0]);
  for (int c = 0; c < 3; ++c) {
    v_frame.centre[c] += v[c];
    const float v_relative = g.v_scales[3 * i + c] * std::exp(bound.log_scales[3 * i + c]);
    v_frame.size += v[c] * arm[c] + v_relative;
    g.v_log_scales[3 * i + c] = v_relative * f.size;
  }
  bind_quat_bwd(f.quat, bound.quats + 4 * i, g.v_quats + 4 * i, g.v_local_quats + 4 * i, v_frame.turn);
}

// To the corners [3, 3] of the triangle. With the edge e = v1 - v0 = |e| a0 and the side d = v2 - v0 = d0 a0 - h a2:
//   omega.a0 = (dd - d0/|e| de).a1 / h,  omega.a1 = -de.a2 / |e|,  omega.a2 = de.a1 / |e|,
//   2 d(size) = de.(a0 + d0/|e| a2) - dd.a2.
void triangle_frame_bwd(const Frame& f, const float* vertices, const std::int32_t* face, const FrameGradient& v, float* v_corners) {
  const auto at = [&](int i) { return Vec3{vertices[3 * face[i]], vertices[3 * face[i] + 1], vertices[3 * face[i] + 2]}; };
  const auto column = [&](int j) { return Vec3{f.rotmat[j], f.rotmat[3 + j], f.rotmat[6 + j]}; };
  const Vec3 edge = at(1) - at(0), side = at(2) - at(0), a0 = column(0), a1 = column(1), a2 = column(2);
  const float length = std::sqrt(dot(edge, edge)), height = -dot(a2, side), along = dot(a0, side);
  Vec3 v_edge{}, v_side{};
  if (length > kMinExtent && height > kMinExtent) {
    const Vec3 turn{v.turn[0], v.turn[1], v.turn[2]};
    const float w0 = dot(turn, a0) / height, w1 = dot(turn, a1) / length, w2 = dot(turn, a2) / length, slope = along / length;
    const float half = 0.5f * v.size;
    v_edge = half * a0 + (w2 - w0 * slope) * a1 + (half * slope - w1) * a2;
    v_side = w0 * a1 + -half * a2;
  }
  const float e[3] = {v_edge.x, v_edge.y, v_edge.z}, d[3] = {v_side.x, v_side.y, v_side.z};
  for (int c = 0; c < 3; ++c) {
    const float third = v.centre[c] / 3;
    v_corners[c] = third - e[c] - d[c];
    v_corners[3 + c] = third + e[c];
    v_corners[6 + c] = third + d[c];
  }
}

}  // namespace

void bind_vjp(const float* vertices, std::size_t vertices_count, const BoundGaussians& bound, int threads, const BindGradients& g) {
  const Groups riders = group_by(bound.count, bound.faces_count, [&](std::size_t i) { return bound.binding[i]; });
  const Groups corners = group_by(3 * bound.faces_count, vertices_count, [&](std::size_t i) { return bound.faces[i]; });
  auto v_corners = make_buffer<float>(9 * bound.faces_count);
  parallel_for(bound.faces_count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t m = begin; m < end; ++m) {
      const Frame f = triangle_frame(vertices, bound.faces + 3 * m);
      FrameGradient v{};
      for (std::size_t k = riders.starts[m]; k < riders.starts[m + 1]; ++k) bind_one_bwd(f, bound, g, riders.items[k], v);
      triangle_frame_bwd(f, vertices, bound.faces + 3 * m, v, &v_corners[9 * m]);
    }
  });
  parallel_for(vertices_count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i)
      for (int c = 0; c < 3; ++c) {
        float sum = 0;
        for (std::size_t k = corners.starts[i]; k < corners.starts[i + 1]; ++k) sum += v_corners[3 * corners.items[k] + c];
        g.v_vertices[3 * i + c] = sum;
      }
  });
}

}  // namespace cap4d
