// Every constant that decides a pixel, once, with where it comes from. The readable reference and the shaders use the same.
#pragma once
#include <cstdint>

namespace cap4d {

// Variance added to both image axes, px^2: half a pixel of blur, so that no Gaussian falls between samples (3DGS; gsplat's eps2d).
inline constexpr float kLowPass = 0.3f;
// A Gaussian whose centre is nearer than this is not drawn, m (gsplat's near_plane; Camera's NEAR in Python).
inline constexpr float kNear = 0.01f;
// The projection's Jacobian is taken at most this far outside the image, in half fields of view beyond the edge (3DGS: 1.3x).
inline constexpr float kJacobianMargin = 0.3f;
// Contributions below this are skipped (3DGS: less than one 8-bit step).
inline constexpr float kAlphaMin = 1.0f / 255.0f;
inline constexpr float kLog2AlphaMin = -7.99435343685886f;  // log2(1 / 255)
// Opacity is clamped here, so that transmittance never reaches 0 and 1 / (1 - alpha) stays finite (3DGS).
inline constexpr float kAlphaMax = 0.99f;
// A pixel is finished before the Gaussian that would take its transmittance below this (3DGS).
inline constexpr float kTransmittanceMin = 1e-4f;
// A quaternion whose largest component is below this has no direction: no rotation, and no gradient.
inline constexpr float kQuatMin = 1e-12f;
// Guard of every division by a length in the triangle frames (GaussianAvatars; fact 27).
inline constexpr double kSafeNorm2 = 1e-20;
// A Gaussian with a colour beyond this is bad data and not drawn: sums and gradients of what is drawn cannot overflow.
inline constexpr float kColorMax = 1e6f;
// A Gaussian farther than this is bad data too, m: squares of its depth and of what divides by it stay in float32.
inline constexpr float kDepthMax = 1e7f;
// How far out, in standard deviations, the radius that densification prunes by reaches (3DGS).
inline constexpr float kRadiusSigmas = 3.0f;

// Cameras take their numbers from the nearest point of a grid this wide, m: a head's own camera from the origin, which costs no digit.
inline constexpr double kPivotStep = 16.0;

inline constexpr int kTileLog2 = 4;
inline constexpr int kTile = 1 << kTileLog2;  // px a side; the unit of work of a thread and of binning
inline constexpr int kMaxSide = 16384;       // px; larger images are refused

inline constexpr int kMaxMapSide = 4096;     // px; of a UV grid

inline constexpr double kPi = 3.14159265358979323846;
inline constexpr float kLog2e = 1.44269504088896341f;

}  // namespace cap4d
