// Which Gaussians meet which tiles: the exact ellipse where alpha >= 1/255 against rows of tiles.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "camera.h"
#include "constants.h"
#include "gaussians.h"

namespace cap4d {

// The pixels of a Gaussian's outline within a band of pixel rows, as an inclusive range of columns; empty when last < first.
struct Span {
  int first, last;
};

// Columns [first, last] of pixel centres inside the outline for rows [row0, row1], clipped to [0, columns).
// The widest chord of an ellipse within a band is at its extreme point, or at the nearest row of the band.
inline Span outline_span(const Splat& s, int row0, int row1, int columns) {
  const float low = std::max(row0 + 0.5f - s.y, -s.half_height), high = std::min(row1 + 0.5f - s.y, s.half_height);
  if (!(low <= high)) return {0, -1};
  const float right = std::min(std::max(s.y_rightmost, low), high), left = std::min(std::max(-s.y_rightmost, low), high);
  const auto half = [&](float dy) { return std::sqrt(s.half_width2 * std::max(0.0f, 1.0f - dy * dy * s.inv_height2)); };
  const float x0 = s.x + s.slope * left - half(left), x1 = s.x + s.slope * right + half(right);
  const float first = std::min(std::max(std::ceil(x0 - 0.5f), 0.0f), static_cast<float>(columns));
  const float last = std::min(std::max(std::floor(x1 - 0.5f), -1.0f), columns - 1.0f);
  return {static_cast<int>(first), static_cast<int>(last)};
}

template <class T>
using Buffer = std::unique_ptr<T[]>;

template <class T>
Buffer<T> make_buffer(std::size_t n) {  // not initialised
  return std::make_unique_for_overwrite<T[]>(n ? n : 1);
}

// The tile-Gaussian pairs of an image, tile after tile, near to far in each.
struct Tiling {
  int columns = 0, rows = 0;
  std::vector<std::uint32_t> tile_offsets;  // [columns * rows + 1] into isects
  Buffer<std::uint32_t> isects;             // ranks
  std::uint32_t count = 0;
  // Only for the gradient: the pairs of rank r are slots[rank_offsets[r]] ..., each an index into isects.
  Buffer<std::uint32_t> slots, rank_offsets;
};

// splats [count] near to far. Raises std::length_error beyond 2^31 pairs.
Tiling tile_splats(const Splat* splats, std::size_t count, const Camera& camera, bool with_slots, int threads);

}  // namespace cap4d
