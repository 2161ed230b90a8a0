// Real spherical harmonics of degree 0 to 3 in a unit direction, and their gradient. Order and signs of 3DGS (gsplat, INRIA).
// Template on float, double or FloatV.
#pragma once
#include "simd.h"

namespace cap4d::CAP4D_ISA {

inline constexpr int kShMax = 16;

// basis [16]: only the first (degree + 1)^2 are written.
template <class T>
CAP4D_INLINE void sh_basis(int degree, T x, T y, T z, T* basis) {
  basis[0] = 0.0f * x + 0.28209479177387814f;
  if (degree < 1) return;
  basis[1] = -0.4886025119029199f * y;
  basis[2] = 0.4886025119029199f * z;
  basis[3] = -0.4886025119029199f * x;
  if (degree < 2) return;
  const T xx = x * x, yy = y * y, zz = z * z;
  basis[4] = 1.0925484305920792f * x * y;
  basis[5] = -1.0925484305920792f * y * z;
  basis[6] = 0.31539156525252005f * (2.0f * zz - xx - yy);
  basis[7] = -1.0925484305920792f * x * z;
  basis[8] = 0.5462742152960396f * (xx - yy);
  if (degree < 3) return;
  basis[9] = -0.5900435899266435f * y * (3.0f * xx - yy);
  basis[10] = 2.890611442640554f * x * y * z;
  basis[11] = -0.4570457994644658f * y * (4.0f * zz - xx - yy);
  basis[12] = 0.3731763325901154f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
  basis[13] = -0.4570457994644658f * x * (4.0f * zz - xx - yy);
  basis[14] = 1.445305721320277f * z * (xx - yy);
  basis[15] = -0.5900435899266435f * x * (xx - 3.0f * yy);
}

// v_direction [3] = sum over k of v_basis[k] d(basis k) / d(x, y, z), x, y, z taken as free.
template <class T>
CAP4D_INLINE void sh_basis_vjp(int degree, T x, T y, T z, const T* v_basis, T* v_direction) {
  T vx = 0.0f * x, vy = vx, vz = vx;
  if (degree >= 1) {
    vx = vx - 0.4886025119029199f * v_basis[3];
    vy = vy - 0.4886025119029199f * v_basis[1];
    vz = vz + 0.4886025119029199f * v_basis[2];
  }
  if (degree >= 2) {
    const T v4 = 1.0925484305920792f * v_basis[4], v5 = -1.0925484305920792f * v_basis[5], v6 = 0.6307831305050401f * v_basis[6];
    const T v7 = -1.0925484305920792f * v_basis[7], v8 = 1.0925484305920792f * v_basis[8];
    vx = vx + v4 * y - v6 * x + v7 * z + v8 * x;
    vy = vy + v4 * x + v5 * z - v6 * y - v8 * y;
    vz = vz + v5 * y + 2.0f * v6 * z + v7 * x;
  }
  if (degree >= 3) {
    const T xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
    const T v9 = -0.5900435899266435f * v_basis[9], v10 = 2.890611442640554f * v_basis[10], v11 = -0.4570457994644658f * v_basis[11];
    const T v12 = 0.3731763325901154f * v_basis[12], v13 = -0.4570457994644658f * v_basis[13], v14 = 1.445305721320277f * v_basis[14];
    const T v15 = -0.5900435899266435f * v_basis[15];
    vx = vx + v9 * 6.0f * xy + v10 * yz - v11 * 2.0f * xy - v12 * 6.0f * xz + v13 * (4.0f * zz - 3.0f * xx - yy) + v14 * 2.0f * xz +
         v15 * 3.0f * (xx - yy);
    vy = vy + v9 * 3.0f * (xx - yy) + v10 * xz + v11 * (4.0f * zz - xx - 3.0f * yy) - v12 * 6.0f * yz - v13 * 2.0f * xy -
         v14 * 2.0f * yz - v15 * 6.0f * xy;
    vz = vz + v10 * xy + v11 * 8.0f * yz + v12 * (6.0f * zz - 3.0f * xx - 3.0f * yy) + v13 * 8.0f * xz + v14 * (xx - yy);
  }
  v_direction[0] = vx, v_direction[1] = vy, v_direction[2] = vz;
}

}  // namespace cap4d::CAP4D_ISA
