// One Gaussian onto the image plane (EWA splatting), and the gradient of that. Template on float, double or FloatV.
// Zwicker et al. 2002, eq. 31, in the form of gsplat (Ye et al. 2024, appendix): the Jacobian is clamped outside the image.
#pragma once
#include "camera.h"
#include "constants.h"
#include "simd.h"

namespace cap4d::CAP4D_ISA {

template <class T>
struct Shape3 {  // what decides a Gaussian's image
  T mean[3], quat[4], scale[3];
};

template <class T>
struct Footprint {
  T x, y, depth;             // px, px, m
  T xx, xy, yy;              // covariance in the image with the low-pass, px^2
  // Its inverse as a completed square, with u = dy - shear dx: density = exp(-(inv_xx dx^2 + inv_uu u^2) / 2). A polynomial in dx
  // and dy would cancel along needles. inv_xx = 1 / xx, inv_uu = xx / det, shear = xy / xx.
  T inv_xx, inv_uu, shear;
  T det;
};

// xx, xu, uu: dL/d(covariance) as the symmetric matrix V of the axes (dx, u), so that dL = d(covariance of (dx, u)) : V with the
// shear held; x and y are of the image.
template <class T>
struct FootprintGrad {
  T x, y, depth, xx, xu, uu;
};

template <class T>
CAP4D_INLINE T absolute(T v) {
  return max(v, -v);
}

// Unit quaternion and 1 / norm. Scaled by the largest component first: no overflow. One without direction gives 0 and 0.
template <class T>
CAP4D_INLINE T normalize_quat(const T* quat, T* unit) {
  const T largest = max(max(absolute(quat[0]), absolute(quat[1])), max(absolute(quat[2]), absolute(quat[3])));
  const T zero = 0.0f * largest;
  const T inverse_largest = keep(less(zero + kQuatMin, largest), 1.0f / largest);
  T q[4];
  for (int i = 0; i < 4; ++i) q[i] = quat[i] * inverse_largest;
  const T norm2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
  const T inverse = 1.0f / sqrt(max(norm2, zero + 1e-6f));
  for (int i = 0; i < 4; ++i) unit[i] = q[i] * inverse;
  return inverse * inverse_largest;
}

template <class T>
CAP4D_INLINE void quat_to_rotmat(const T* q, T r[3][3]) {
  const T w = q[0], x = q[1], y = q[2], z = q[3];
  r[0][0] = 1.0f - 2.0f * (y * y + z * z), r[0][1] = 2.0f * (x * y - w * z), r[0][2] = 2.0f * (x * z + w * y);
  r[1][0] = 2.0f * (x * y + w * z), r[1][1] = 1.0f - 2.0f * (x * x + z * z), r[1][2] = 2.0f * (y * z - w * x);
  r[2][0] = 2.0f * (x * z - w * y), r[2][1] = 2.0f * (y * z + w * x), r[2][2] = 1.0f - 2.0f * (x * x + y * y);
}

// v_q [4] of a unit quaternion.
template <class T>
CAP4D_INLINE void quat_to_rotmat_vjp(const T* q, const T v[3][3], T* v_q) {
  const T w = q[0], x = q[1], y = q[2], z = q[3];
  v_q[0] = 2.0f * (x * (v[2][1] - v[1][2]) + y * (v[0][2] - v[2][0]) + z * (v[1][0] - v[0][1]));
  v_q[1] = 2.0f * (-2.0f * x * (v[1][1] + v[2][2]) + y * (v[0][1] + v[1][0]) + z * (v[0][2] + v[2][0]) + w * (v[2][1] - v[1][2]));
  v_q[2] = 2.0f * (x * (v[0][1] + v[1][0]) - 2.0f * y * (v[0][0] + v[2][2]) + z * (v[1][2] + v[2][1]) + w * (v[0][2] - v[2][0]));
  v_q[3] = 2.0f * (x * (v[0][2] + v[2][0]) + y * (v[1][2] + v[2][1]) - 2.0f * z * (v[0][0] + v[1][1]) + w * (v[1][0] - v[0][1]));
}

// Everything between a Gaussian and its footprint that the gradient needs again.
template <class T>
struct Projection {
  T view[3];         // the mean in the camera, m
  T inverse_z;
  T ratio[2], clamped[2];  // x / z and y / z; where the Jacobian is taken
  T jacobian_view[2][3];   // Jacobian times world-to-view rotation
  T unit[4], inverse_norm, rotmat[3][3];
  T q[2][3];         // jacobian_view * rotmat
  T m[2][3];         // q * scale: the covariance is m m^T
  Footprint<T> footprint;
};

// The mean in the camera and in the image, and the Jacobian of the perspective there.
template <class T>
CAP4D_INLINE void project_mean(const Camera& camera, const T* mean, Projection<T>& p, T* position) {
  const T arm[3] = {mean[0] - camera.pivot[0], mean[1] - camera.pivot[1], mean[2] - camera.pivot[2]};
  for (int i = 0; i < 3; ++i)
    p.view[i] = camera.rotation[i][0] * arm[0] + camera.rotation[i][1] * arm[1] + camera.rotation[i][2] * arm[2] + camera.translation[i];
  p.inverse_z = 1.0f / p.view[2];
  const T zero = 0.0f * p.inverse_z;
  const float focal[2] = {camera.fx, camera.fy}, centre[2] = {camera.cx, camera.cy};
  const float low[2] = {camera.x_min, camera.y_min}, high[2] = {camera.x_max, camera.y_max};
  for (int i = 0; i < 2; ++i) {
    p.ratio[i] = p.view[i] * p.inverse_z;
    p.clamped[i] = min(max(p.ratio[i], zero + low[i]), zero + high[i]);
    position[i] = focal[i] * p.ratio[i] + centre[i];
    const T scale = focal[i] * p.inverse_z, shear = scale * p.clamped[i];
    for (int j = 0; j < 3; ++j) p.jacobian_view[i][j] = scale * camera.rotation[i][j] - shear * camera.rotation[2][j];
  }
}

// position [2] px, depth m; the covariance without the low-pass is m m^T.
template <class T>
CAP4D_INLINE Footprint<T> footprint(const T* position, T depth, const T m[2][3]) {
  const T *m0 = m[0], *m1 = m[1];
  const T xx = m0[0] * m0[0] + m0[1] * m0[1] + m0[2] * m0[2], yy = m1[0] * m1[0] + m1[1] * m1[1] + m1[2] * m1[2];
  const T xy = m0[0] * m1[0] + m0[1] * m1[1] + m0[2] * m1[2];
  // det(m m^T) as a sum of squares (Cauchy-Binet): xx yy - xy^2 would cancel for needles.
  const T c0 = m0[1] * m1[2] - m0[2] * m1[1], c1 = m0[2] * m1[0] - m0[0] * m1[2], c2 = m0[0] * m1[1] - m0[1] * m1[0];
  const T det = c0 * c0 + c1 * c1 + c2 * c2 + kLowPass * (xx + yy) + kLowPass * kLowPass;
  const T wide_xx = xx + kLowPass;
  return {position[0], position[1], depth, wide_xx, xy, yy + kLowPass, 1.0f / wide_xx, wide_xx / det, xy / wide_xx, det};
}

template <class T>
CAP4D_INLINE Projection<T> project(const Camera& camera, const Shape3<T>& g) {
  Projection<T> p;
  T position[2];
  project_mean(camera, g.mean, p, position);
  p.inverse_norm = normalize_quat(g.quat, p.unit);
  quat_to_rotmat(p.unit, p.rotmat);
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < 3; ++j) {
      p.q[i][j] = p.jacobian_view[i][0] * p.rotmat[0][j] + p.jacobian_view[i][1] * p.rotmat[1][j] + p.jacobian_view[i][2] * p.rotmat[2][j];
      p.m[i][j] = p.q[i][j] * g.scale[j];
    }
  p.footprint = footprint(position, p.view[2], p.m);
  return p;
}

template <class T>
CAP4D_INLINE Shape3<T> project_vjp(const Camera& camera, const Shape3<T>& g, const Projection<T>& p, const FootprintGrad<T>& v) {
  Shape3<T> out;
  const Footprint<T>& f = p.footprint;
  const float focal[2] = {camera.fx, camera.fy};
  const float low[2] = {camera.x_min, camera.y_min}, high[2] = {camera.x_max, camera.y_max};
  const T v_position[2] = {v.x, v.y};
  T v_m[2][3], v_q[2][3], v_rotmat[3][3];
  const T *m0 = p.m[0], *m1 = p.m[1];
  const T minors[3] = {m0[1] * m1[2] - m0[2] * m1[1], m0[2] * m1[0] - m0[0] * m1[2], m0[0] * m1[1] - m0[1] * m1[0]};
  for (int j = 0; j < 3; ++j) {
    // v_m = 2 v_covariance m, all of it sheared: rows 1 of m and q less shear times rows 0, and v_m sheared back at the end.
    // m1 - shear m0 cancels along a needle; it is (low-pass m1 + (m0 x m1) x m0) / xx.
    const int k = (j + 1) % 3, l = (j + 2) % 3;
    const T m_u = (kLowPass * m1[j] + (minors[k] * m0[l] - minors[l] * m0[k])) * f.inv_xx, q_u = p.q[1][j] - f.shear * p.q[0][j];
    const T along = 2.0f * (v.xx * m0[j] + v.xu * m_u), across = 2.0f * (v.xu * m0[j] + v.uu * m_u);
    out.scale[j] = along * p.q[0][j] + across * q_u;
    v_m[0][j] = along - f.shear * across;
    v_m[1][j] = across;
    for (int i = 0; i < 2; ++i) v_q[i][j] = v_m[i][j] * g.scale[j];
    for (int i = 0; i < 3; ++i) v_rotmat[i][j] = p.jacobian_view[0][i] * v_q[0][j] + p.jacobian_view[1][i] * v_q[1][j];
  }
  T v_view[3];
  v_view[2] = v.depth;
  const T zero = 0.0f * v.depth;
  for (int i = 0; i < 2; ++i) {
    T v_jv[3];
    for (int j = 0; j < 3; ++j) v_jv[j] = v_q[i][0] * p.rotmat[j][0] + v_q[i][1] * p.rotmat[j][1] + v_q[i][2] * p.rotmat[j][2];
    const float* right = camera.rotation[i];
    const float* forward = camera.rotation[2];
    const T v_scale = v_jv[0] * right[0] + v_jv[1] * right[1] + v_jv[2] * right[2];
    const T v_shear = -(v_jv[0] * forward[0] + v_jv[1] * forward[1] + v_jv[2] * forward[2]);
    const T scale = focal[i] * p.inverse_z;
    // scale = f / z, shear = scale * clamped, position = f ratio + centre, ratio = view / z
    T v_ratio = focal[i] * v_position[i];
    const T inside = v_shear * scale;
    v_ratio = v_ratio + keep(less(zero + low[i], p.ratio[i]), keep(less(p.ratio[i], zero + high[i]), inside));
    v_view[i] = v_ratio * p.inverse_z;
    v_view[2] = v_view[2] - (v_scale + v_shear * p.clamped[i]) * scale * p.inverse_z - v_ratio * p.ratio[i] * p.inverse_z;
  }
  for (int j = 0; j < 3; ++j)
    out.mean[j] = camera.rotation[0][j] * v_view[0] + camera.rotation[1][j] * v_view[1] + camera.rotation[2][j] * v_view[2];
  T v_unit[4];
  quat_to_rotmat_vjp(p.unit, v_rotmat, v_unit);
  const T along = v_unit[0] * p.unit[0] + v_unit[1] * p.unit[1] + v_unit[2] * p.unit[2] + v_unit[3] * p.unit[3];
  for (int i = 0; i < 4; ++i) out.quat[i] = (v_unit[i] - along * p.unit[i]) * p.inverse_norm;
  return out;
}

}  // namespace cap4d::CAP4D_ISA
