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
constexpr float kQuatNormMin = 1e-10f;  // a shorter quaternion is not stretched to unit length
constexpr float kMinExtent = 1e-7f;  // m; a triangle whose edge or height is shorter passes no gradient to its frame

// Frames are computed in double: in a sliver of a thousandth of its edge's height float32 has lost the normal's last four digits,
// and three points in a line have a normal of rounding errors.
struct Vec3 {
  double x, y, z;
};
Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
Vec3 operator*(double s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
double dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
double safe_norm(Vec3 a) { return std::sqrt(std::max(dot(a, a), kSafeNorm2)); }
Vec3 safe_normalize(Vec3 a) { return 1.0 / safe_norm(a) * a; }

struct Triangle {
  Vec3 corner, edge, side;  // v0, v1 - v0, v2 - v0
  Vec3 axes[3];             // edge, normal, their cross product negated
};

Triangle triangle_at(const float* vertices, const std::int32_t* face) {
  const auto at = [&](int i) { return Vec3{vertices[3 * face[i]], vertices[3 * face[i] + 1], vertices[3 * face[i] + 2]}; };
  const Vec3 v0 = at(0), edge = at(1) - v0, side = at(2) - v0;
  const Vec3 a0 = safe_normalize(edge), a1 = safe_normalize(cross(a0, side));
  return {v0, edge, side, {a0, a1, -1.0 * cross(a1, a0)}};
}

struct Frame {
  float rotmat[9];  // columns: edge, normal, their cross product negated
  float quat[4];
  float centre[3];
  float size;
};

// The best conditioned of Shepperd's four forms, in the order of rotmat_to_quat of rotation.py. A degenerate frame (not a rotation)
// still gives a unit quaternion.
void rotmat_to_quat(const double* r, float* out) {
  const double trace = r[0] + r[4] + r[8];
  double q[4];
  const double scores[4] = {trace, r[0], r[4], r[8]};
  switch (std::max_element(scores, scores + 4) - scores) {
    case 0: q[0] = 1 + trace, q[1] = r[7] - r[5], q[2] = r[2] - r[6], q[3] = r[3] - r[1]; break;
    case 1: q[0] = r[7] - r[5], q[1] = 1 + 2 * r[0] - trace, q[2] = r[1] + r[3], q[3] = r[2] + r[6]; break;
    case 2: q[0] = r[2] - r[6], q[1] = r[1] + r[3], q[2] = 1 + 2 * r[4] - trace, q[3] = r[5] + r[7]; break;
    default: q[0] = r[3] - r[1], q[1] = r[2] + r[6], q[2] = r[5] + r[7], q[3] = 1 + 2 * r[8] - trace;
  }
  const double inverse = 1.0 / std::sqrt(std::max(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3], kSafeNorm2));
  for (int i = 0; i < 4; ++i) out[i] = static_cast<float>(q[i] * inverse);
}

Frame frame_of(const Triangle& t) {
  Frame f{};
  double rotmat[9];
  for (int j = 0; j < 3; ++j) rotmat[j] = t.axes[j].x, rotmat[3 + j] = t.axes[j].y, rotmat[6 + j] = t.axes[j].z;
  rotmat_to_quat(rotmat, f.quat);
  std::copy_n(rotmat, 9, f.rotmat);
  const Vec3 centre = t.corner + (1.0 / 3) * (t.edge + t.side);
  f.centre[0] = static_cast<float>(centre.x), f.centre[1] = static_cast<float>(centre.y), f.centre[2] = static_cast<float>(centre.z);
  f.size = static_cast<float>(0.5 * (safe_norm(t.edge) + std::abs(dot(t.axes[2], t.side))));
  return f;
}

// unit [4] = quat over its norm, which is returned; one shorter than 1e-10 is divided by that.
float normalize_quat(const float* quat, float* unit) {
  float scale = 1;
  float norm2 = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
  if (norm2 > 1e30f) {  // about to overflow
    scale = 1 / std::max({std::abs(quat[0]), std::abs(quat[1]), std::abs(quat[2]), std::abs(quat[3])});
    norm2 = 0;
    for (int i = 0; i < 4; ++i) norm2 += scale * quat[i] * (scale * quat[i]);
  }
  const float norm = std::max(std::sqrt(norm2), kQuatNormMin), inverse = 1 / norm;
  for (int i = 0; i < 4; ++i) unit[i] = scale * quat[i] * inverse;
  return norm / scale;
}

void bind_one(const Frame& f, const float* mean, const float* quat, const float* log_scale, float* out_mean, float* out_quat, float* out_scale) {
  for (int i = 0; i < 3; ++i) {
    const float* r = f.rotmat + 3 * i;
    out_mean[i] = (r[0] * mean[0] + r[1] * mean[1] + r[2] * mean[2]) * f.size + f.centre[i];
    out_scale[i] = std::exp(log_scale[i]) * f.size;
  }
  float unit[4];
  normalize_quat(quat, unit);
  const float w = unit[0], x = unit[1], y = unit[2], z = unit[3];
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
    for (std::size_t i = begin; i < end; ++i) frames[i] = frame_of(triangle_at(vertices, bound.faces + 3 * i));
  });
  parallel_for(bound.count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i)
      bind_one(frames[bound.binding[i]], bound.means + 3 * i, bound.quats + 4 * i, bound.log_scales + 3 * i, means + 3 * i, quats + 4 * i,
               scales + 3 * i);
  });
}

TriangleFrame triangle_frame(const float* vertices, const std::int32_t* face) {
  const Triangle t = triangle_at(vertices, face);
  const Frame f = frame_of(t);
  TriangleFrame out{};
  for (int i = 0; i < 9; ++i) out.turn[i] = f.size * f.rotmat[i];
  std::copy_n(f.centre, 3, out.centre);
  out.size = f.size;
  out.flat = dot(t.axes[1], t.axes[1]) < 0.5;
  return out;
}

void upright(const TriangleFrame& frame, float* rotmat) {
  double axes[9];
  for (int i = 0; i < 9; ++i) axes[i] = frame.turn[i] / frame.size;
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
// have one order, whatever the number of threads. Fewer than 2^32 rows.
struct Groups {
  std::vector<std::uint32_t> starts, items;
};

template <class Key>
Groups group_by(std::size_t count, std::size_t keys, const Key& key_of) {
  Groups g{std::vector<std::uint32_t>(keys + 1), std::vector<std::uint32_t>(count)};
  for (std::size_t i = 0; i < count; ++i) ++g.starts[key_of(i) + 1];
  for (std::size_t k = 0; k < keys; ++k) g.starts[k + 1] += g.starts[k];
  std::vector<std::uint32_t> next(g.starts.begin(), g.starts.end() - 1);
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
  float u[4];
  const float norm = normalize_quat(quat, u);
  const float* q = face;
  const float v_u[4] = {q[0] * v[0] + q[1] * v[1] + q[2] * v[2] + q[3] * v[3], q[0] * v[1] - q[1] * v[0] - q[2] * v[3] + q[3] * v[2],
                        q[0] * v[2] + q[1] * v[3] - q[2] * v[0] - q[3] * v[1], q[0] * v[3] - q[1] * v[2] + q[2] * v[1] - q[3] * v[0]};
  const float along = norm > kQuatNormMin ? u[0] * v_u[0] + u[1] * v_u[1] + u[2] * v_u[2] + u[3] * v_u[3] : 0.0f;
  const float inverse = 1 / norm;
  for (int i = 0; i < 4; ++i) v_quat[i] = (v_u[i] - u[i] * along) * inverse;
  const float o[4] = {q[0] * u[0] - q[1] * u[1] - q[2] * u[2] - q[3] * u[3], q[0] * u[1] + q[1] * u[0] + q[2] * u[3] - q[3] * u[2],
                      q[0] * u[2] - q[1] * u[3] + q[2] * u[0] + q[3] * u[1], q[0] * u[3] + q[1] * u[2] - q[2] * u[1] + q[3] * u[0]};
  turn[0] += 0.5f * (-o[1] * v[0] + o[0] * v[1] - o[3] * v[2] + o[2] * v[3]);
  turn[1] += 0.5f * (-o[2] * v[0] + o[3] * v[1] + o[0] * v[2] - o[1] * v[3]);
  turn[2] += 0.5f * (-o[3] * v[0] - o[2] * v[1] + o[1] * v[2] + o[0] * v[3]);
}

// A Gaussian that comes out of `bind` as anything but numbers is never drawn, and must not reach its triangle.
void bind_one_bwd(const Frame& f, const BoundGaussians& bound, const BindGradients& g, std::size_t i, FrameGradient& v_frame) {
  const float *x = bound.means + 3 * i, *quat = bound.quats + 4 * i, *v = g.v_means + 3 * i;
  float arm[3], relative[3], posed = 0.0f * quat[0] + 0.0f * quat[1] + 0.0f * quat[2] + 0.0f * quat[3];  // R x, exp(log_scales)
  for (int c = 0; c < 3; ++c) {
    arm[c] = f.rotmat[3 * c] * x[0] + f.rotmat[3 * c + 1] * x[1] + f.rotmat[3 * c + 2] * x[2];
    relative[c] = std::exp(bound.log_scales[3 * i + c]);
    posed += 0.0f * (f.size * arm[c] + f.centre[c] + f.size * relative[c]);
  }
  if (!std::isfinite(posed)) {
    std::fill_n(g.v_local_means + 3 * i, 3, 0.0f);
    std::fill_n(g.v_local_quats + 4 * i, 4, 0.0f);
    std::fill_n(g.v_log_scales + 3 * i, 3, 0.0f);
    return;
  }
  for (int c = 0; c < 3; ++c) g.v_local_means[3 * i + c] = f.size * (f.rotmat[c] * v[0] + f.rotmat[3 + c] * v[1] + f.rotmat[6 + c] * v[2]);
  v_frame.turn[0] += f.size * (arm[1] * v[2] - arm[2] * v[1]);
  v_frame.turn[1] += f.size * (arm[2] * v[0] - arm[0] * v[2]);
  v_frame.turn[2] += f.size * (arm[0] * v[1] - arm[1] * v[0]);
  for (int c = 0; c < 3; ++c) {
    v_frame.centre[c] += v[c];
    const float v_relative = g.v_scales[3 * i + c] * relative[c];
    v_frame.size += v[c] * arm[c] + v_relative;
    g.v_log_scales[3 * i + c] = v_relative * f.size;
  }
  bind_quat_bwd(f.quat, quat, g.v_quats + 4 * i, g.v_local_quats + 4 * i, v_frame.turn);
}

// To the corners [3, 3] of the triangle. With the edge e = v1 - v0 = |e| a0 and the side d = v2 - v0 = d0 a0 - h a2:
//   omega.a0 = (dd - d0/|e| de).a1 / h,  omega.a1 = -de.a2 / |e|,  omega.a2 = de.a1 / |e|,
//   2 d(size) = de.(a0 + d0/|e| a2) - dd.a2.
void triangle_bwd(const Triangle& t, const FrameGradient& v, float* v_corners) {
  const auto [a0, a1, a2] = t.axes;
  const double length = std::sqrt(dot(t.edge, t.edge)), height = -dot(a2, t.side), along = dot(a0, t.side);
  Vec3 v_edge{}, v_side{};
  if (length > kMinExtent && height > kMinExtent) {
    const Vec3 turn{v.turn[0], v.turn[1], v.turn[2]};
    const double w0 = dot(turn, a0) / height, w1 = dot(turn, a1) / length, w2 = dot(turn, a2) / length, slope = along / length;
    const double half = 0.5 * v.size;
    v_edge = half * a0 + (w2 - w0 * slope) * a1 + (half * slope - w1) * a2;
    v_side = w0 * a1 + -half * a2;
  }
  const double e[3] = {v_edge.x, v_edge.y, v_edge.z}, d[3] = {v_side.x, v_side.y, v_side.z};
  for (int c = 0; c < 3; ++c) {
    const double third = v.centre[c] / 3.0;
    v_corners[c] = static_cast<float>(third - e[c] - d[c]);
    v_corners[3 + c] = static_cast<float>(third + e[c]);
    v_corners[6 + c] = static_cast<float>(third + d[c]);
  }
}

}  // namespace

void bind_vjp(const float* vertices, std::size_t vertices_count, const BoundGaussians& bound, int threads, const BindGradients& g) {
  const Groups riders = group_by(bound.count, bound.faces_count, [&](std::size_t i) { return bound.binding[i]; });
  const Groups corners = group_by(3 * bound.faces_count, vertices_count, [&](std::size_t i) { return bound.faces[i]; });
  auto v_corners = make_buffer<float>(9 * bound.faces_count);
  parallel_for(bound.faces_count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t m = begin; m < end; ++m) {
      const Triangle triangle = triangle_at(vertices, bound.faces + 3 * m);
      const Frame f = frame_of(triangle);
      FrameGradient v{};
      for (std::size_t k = riders.starts[m]; k < riders.starts[m + 1]; ++k) bind_one_bwd(f, bound, g, riders.items[k], v);
      triangle_bwd(triangle, v, &v_corners[9 * m]);
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
