// Gaussians that ride on triangles (GaussianAvatars, Qian et al. 2024; fact 27): local parameters and a posed mesh -> posed Gaussians.
#pragma once
#include <cstddef>
#include <cstdint>

#include "packed.h"

namespace cap4d {

// What does not change while the mesh moves (not owned). Indices are checked by the caller.
struct BoundGaussians {
  std::size_t count, faces_count;
  const std::int32_t* faces;    // [M, 3]
  const std::int32_t* binding;  // [N] into faces
  const float *means, *quats, *log_scales;  // [N, 3] in units of the triangle's size, [N, 4] wxyz, [N, 3]
};

// means = R (s x) + centre, scales = exp(log_scales) s, quats = q_face (x) normalise(quats).
// A triangle without area gets some rotation and its own (possibly zero) size; nothing becomes NaN that was not.
void bind(const float* vertices, const BoundGaussians& bound, int threads, float* means, float* quats, float* scales);

// The place of one triangle, in double as `bind` has it.
TriangleFrame triangle_frame(const float* vertices, const std::int32_t* face);

// The rotation that `bind` gives to what rides on a flat triangle, in place of its `turn`.
void upright(const TriangleFrame& frame, float* rotmat);

// The VJP of `bind`: from gradients of its outputs to those of vertices [G, 3], means, quats and log_scales, all overwritten.
// A triangle without area passes on what moves its centre and nothing else; a Gaussian whose pose is not finite passes on nothing.
struct BindGradients {
  const float *v_means, *v_quats, *v_scales;                    // in
  float *v_vertices, *v_local_means, *v_local_quats, *v_log_scales;  // out
};
void bind_vjp(const float* vertices, std::size_t vertices_count, const BoundGaussians& bound, int threads, const BindGradients& gradients);

}  // namespace cap4d
