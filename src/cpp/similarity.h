// How alike two images are: mean absolute difference and structural similarity (Wang et al. 2004, eq. 13; an 11 x 11 Gaussian window of
// sigma 1.5, zero beyond the border), with the gradient of both. Values lie [H, W, C]; a row is W C numbers and a pixel's neighbours are
// C apart, so every channel is blurred at once.
#pragma once
#include <cstddef>

namespace cap4d {

inline constexpr int kWindow = 11, kReach = kWindow / 2;

struct SimilarityView {  // not owned
  const float *image, *target;  // [height][row]
  std::size_t height, row;      // row: W C
  int channels;
  float window[kWindow];  // sums to 1
  float* partials;        // [3][height][row] dS/d(mean of x), dS/d(mean of x^2), dS/d(mean of x y) at every place
};

struct SimilaritySums {
  double absolute, structural;
};

// Weights of the two means in the gradient.
struct SimilarityGradient {
  float absolute, structural;
  float* v_image;  // [height][row]
};

// One row each; compiled once per instruction set. `scratch` holds scratch_size() numbers.
struct SimilarityKernels {
  SimilaritySums (*forward)(const SimilarityView&, std::size_t y, float* scratch);
  void (*backward)(const SimilarityView&, std::size_t y, const SimilarityGradient&, float* scratch);
};
const SimilarityKernels& similarity_kernels();

// Means over all values. The same bits for any number of threads.
SimilaritySums similarity(const SimilarityView& view, int threads);
void similarity_vjp(const SimilarityView& view, int threads, const SimilarityGradient& gradient);

}  // namespace cap4d
