#include "tiles.h"

#include <utility>

#include "parallel.h"

namespace cap4d {
namespace {

// Ranks are binned in chunks; a tile's list is the chunks' lists one after the other, so their number never shows.
constexpr std::size_t kChunks = 16;

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

void list_tiles(const Splat& splat, TileBox box, const Camera& camera, std::vector<std::uint32_t>& tiles) {
  const std::uint32_t columns = grid_of(camera).columns;
  const bool thin = box.x0 == box.x1 || box.y0 == box.y1;  // an ellipse meets every tile of a box one tile wide
  for (int row = box.y0; row <= box.y1; ++row) {
    int first = box.x0, last = box.x1;
    if (!thin) {
      const Span span = outline_span(splat, row * kTile, std::min((row + 1) * kTile, camera.height) - 1, camera.width);
      if (span.last < span.first) continue;
      first = span.first / kTile, last = span.last / kTile;
    }
    for (int column = first; column <= last; ++column) tiles.push_back(row * columns + column);
  }
}

TileLists make_tile_lists(const Pairs& pairs, const std::uint32_t* order, std::size_t drawn, Grid grid, bool with_slots, int threads) {
  const std::size_t tiles = grid.count(), size = (drawn + kChunks - 1) / kChunks;
  TileLists lists;
  lists.isects = make_buffer<std::uint32_t>(pairs.count);
  if (with_slots) lists.slots = make_buffer<std::uint32_t>(pairs.count);
  lists.offsets.resize(tiles + 1);
  std::vector<std::uint32_t> places(kChunks * tiles, 0);  // first counts, then where the chunk's next Gaussian of the tile goes
  const auto each_pair = [&](std::size_t chunk, auto&& visit) {
    std::uint32_t* place = places.data() + chunk * tiles;
    for (std::size_t rank = std::min(drawn, chunk * size); rank < std::min(drawn, (chunk + 1) * size); ++rank) {
      const std::uint32_t id = order[rank];
      for (std::uint32_t pair = pairs.offsets[id]; pair < pairs.offsets[id + 1]; ++pair) visit(id, pair, place[pairs.tiles[pair]]++);
    }
  };
  parallel_for(kChunks, 1, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t chunk = begin; chunk < end; ++chunk) each_pair(chunk, [](std::uint32_t, std::uint32_t, std::uint32_t) {});
  });
  std::uint32_t next = 0;
  for (std::size_t tile = 0; tile < tiles; ++tile) {
    lists.offsets[tile] = next;
    for (std::size_t chunk = 0; chunk < kChunks; ++chunk) next += std::exchange(places[chunk * tiles + tile], next);
  }
  lists.offsets[tiles] = next;
  parallel_for(kChunks, 1, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t chunk = begin; chunk < end; ++chunk)
      each_pair(chunk, [&](std::uint32_t id, std::uint32_t pair, std::uint32_t place) {
        lists.isects[place] = id;
        if (with_slots) lists.slots[place] = pair;
      });
  });
  return lists;
}

}  // namespace cap4d
