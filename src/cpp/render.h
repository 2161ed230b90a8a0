// The whole splatting pipeline: project, sort by depth, list per tile, rasterise; and its gradient.
#pragma once
#include "camera.h"
#include "gaussians.h"
#include "kernels.h"
#include "tiles.h"

namespace cap4d {

// What the forward pass leaves for the gradient. Independent of the caller's arrays.
struct Rendered {
  Camera camera;
  std::size_t count = 0, drawn = 0;
  float background[3] = {0, 0, 0};
  Buffer<std::int32_t> radii;  // [N] 3 standard deviations, px; 0 = not drawn
  Buffer<Splat> splats;        // [N] where drawn
  Pairs pairs;
  TileLists lists;
};

enum class Pass { kPlay, kTrain };  // kTrain keeps what the gradient needs

// Raises std::length_error beyond 2^31 tile-Gaussian pairs.
Rendered render_fwd(const Camera& camera, const GaussiansView& gaussians, const float* background, Pass pass, int threads, const Image& image);

// `image` is the forward pass's output, `gaussians` its input. The same bits for any number of threads.
void render_bwd(const Rendered& rendered, const GaussiansView& gaussians, const Image& image, const ImageGrad& v_image, int threads,
                const GaussianGrads& grads);

}  // namespace cap4d
