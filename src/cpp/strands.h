// Pictures of hair: thin lines with a width below or about a pixel, blended near to far in front of a surface's depth.
#pragma once
#include <cstddef>
#include <cstdint>
#include <span>

namespace cap4d {

struct StrandPoints {
  std::span<const float> xyz;     // [N, 3] x px, y px (pixel centres at .5), depth
  std::span<const float> rgba;    // [N, 4] straight colour and opacity
  std::span<const float> widths;  // [N] px
};

struct StrandImage {
  int height, width;
  const float* depth;     // [H, W] of the surface; a point is hidden where it lies further than `softness` behind it
  float softness;         // of that edge, in units of depth; above 0
  float* rgb;             // [H, W, 3] in, out: premultiplied
  float* transmittance;   // [H, W] in, out: what is still seen of what lies behind; starts at 1
};

// Draws segments, each from point `i` to point `i + 1` for `i` in `order`, nearest first (the caller sorts and checks i + 1 < N). Pixels
// of a segment are half open along its longer axis, so that the segments of one strand do not overlap. Those with a point that is not
// finite, or further out of the image than kStrandMargin, are skipped.
inline constexpr float kStrandMargin = 4096.0f;  // px
void draw_strands(const StrandPoints& points, std::span<const std::uint32_t> order, const StrandImage& image);

}  // namespace cap4d
