#include "tiles.h"

#include <cmath>

namespace cap4d {
namespace {

struct Span {  // inclusive
  int first, last;
};

// Columns of pixel centres inside the outline for rows [row0, row1], clipped to [0, columns). The widest chord of an ellipse
// within a band is at its extreme point, or at the row of the band nearest to that.
Span outline_span(const Splat& s, int row0, int row1, int columns) {
  const float low = std::max(row0 + 0.5f - s.y, -s.half_height), high = std::min(row1 + 0.5f - s.y, s.half_height);
  if (!(low <= high)) return {0, -1};
  const float right = std::min(std::max(s.y_rightmost, low), high), left = std::min(std::max(-s.y_rightmost, low), high);
  const auto half = [&](float dy) { return std::sqrt(s.half_width2 * std::max(0.0f, 1.0f - dy * dy * s.inv_height2)); };
  const float x0 = s.x + s.slope * left - half(left), x1 = s.x + s.slope * right + half(right), end = static_cast<float>(columns);
  return {static_cast<int>(std::clamp(x0 + 0.499f, 0.0f, end)), static_cast<int>(std::clamp(x1 + 0.501f, 0.0f, end)) - 1};
}

}  // namespace

TileSet tiles_of(const Splat& splat, TileBox box, const Camera& camera, std::vector<std::uint32_t>& list, std::uint32_t& count) {
  const std::uint32_t columns = grid_of(camera).columns;
  const bool thin = box.x0 == box.x1 || box.y0 == box.y1;  // an ellipse meets every tile of a box one tile wide
  const bool small = box.x1 - box.x0 < TileSet::kSide && box.y1 - box.y0 < TileSet::kSide;
  const std::size_t before = list.size();
  std::uint32_t mask = 0;
  for (int row = box.y0; row <= box.y1; ++row) {
    int first = box.x0, last = box.x1;
    if (!thin) {
      const Span span = outline_span(splat, row * kTile, std::min((row + 1) * kTile, camera.height) - 1, camera.width);
      if (span.last < span.first) continue;
      first = std::max(first, span.first / kTile), last = std::min(last, span.last / kTile);
    }
    if (small && first <= last) mask |= ((1u << (last - box.x0 + 1)) - (1u << (first - box.x0))) << (row - box.y0) * TileSet::kSide;
    if (!small)
      for (int column = first; column <= last; ++column) list.push_back(row * columns + column);
  }
  count = small ? std::popcount(mask) : static_cast<std::uint32_t>(list.size() - before);
  return small ? TileSet::small(box.x0, box.y0, mask) : TileSet::listed();
}

}  // namespace cap4d
