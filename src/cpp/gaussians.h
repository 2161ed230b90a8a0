// What goes through the splatting pipeline: the caller's Gaussians, their images, and the gradients of both.
#pragma once
#include <cstddef>
#include <cstdint>

namespace cap4d {

// The caller's activated Gaussians (not owned).
struct GaussiansView {
  std::size_t count;
  int sh_count;            // coefficients stored per channel: 1, 4, 9 or 16
  int sh_degree;           // degree evaluated, at most what is stored
  const float* means;      // [N, 3] m
  const float* quats;      // [N, 4] wxyz, any norm
  const float* scales;     // [N, 3] m
  const float* opacities;  // [N]
  const float* sh;         // [N, sh_count, 3]
};

struct GaussianGrads {  // caller-owned outputs, shaped like the inputs; every element is written
  float *means, *quats, *scales, *opacities, *sh;
  float* means2d;  // [N, 2] dL/d(image position), per px
};

// The image of one Gaussian: all that a pixel reads, one cache line.
// alpha(dx, dy) = exp2(log2_opacity + a dx^2 + c (dy - shear dx)^2), dx, dy = pixel centre - (x, y) in px: a sum of squares, since
// the same polynomial multiplied out cancels along needles and can exceed log2_opacity.
// Where alpha >= 1/255 is an ellipse; the first fields are its outline (see outline_span in tiles.cpp).
struct alignas(64) Splat {
  float x, y;          // px
  float half_height;   // px
  float slope;         // x of the chord's middle per dy
  float y_rightmost;   // dy at which x is largest
  float half_width2;   // px^2, of the chord at dy = 0
  float inv_height2;   // 1 / half_height^2
  float log2_opacity;
  float a, c, shear;   // exponent in base 2: a, c < 0
  float red, green, blue, depth;
  float unused;
};
static_assert(sizeof(Splat) == 64);

// The tiles that a splat's bounding box meets, inclusive; empty when x1 < x0 or y1 < y0.
struct TileBox {
  std::int16_t x0, x1, y0, y1;
};

// A Gaussian's pairs with the tiles it meets, counted from the first of its piece of work; and where its list of tiles begins there,
// if it has one.
struct PairRun {
  std::uint32_t first, count, listed;
};

// Sums over the pixels of one tile (or of the image) of what one Gaussian receives; of the colours where they are not clamped.
// s = dL/d(ln alpha) at a pixel; its moments about the mean in dx and u = dy - shear dx give the gradients of position, covariance
// and opacity.
struct SplatGrad {
  float red, green, blue, depth;
  float s, sx, su, sxx;
  float sxu, suu, unused[2];
};

}  // namespace cap4d
