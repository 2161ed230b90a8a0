#include "tiles.h"

#include <stdexcept>
#include <utility>

#include "parallel.h"

namespace cap4d {
namespace {

// Chunks of ranks are binned independently; a tile's list is the chunks' lists one after the other, so their number is free.
constexpr std::size_t kChunks = 16;
constexpr std::uint64_t kMaxPairs = 1ull << 31;

struct Chunk {
  std::vector<std::uint32_t> tiles;    // of the chunk's pairs, rank after rank
  std::vector<std::uint32_t> counts;   // per tile; later the place of the chunk's next pair in it
  std::vector<std::uint32_t> per_rank;
  std::uint32_t first_pair = 0;
};

int floor_div_tile(float pixel, int limit) {
  return std::clamp(static_cast<int>(std::floor(std::clamp(pixel, -1.0f, static_cast<float>(kMaxSide)) / kTile)), 0, limit);
}

void list_tiles(const Splat* splats, std::size_t begin, std::size_t end, const Camera& camera, const Tiling& tiling, Chunk& chunk) {
  chunk.counts.assign(static_cast<std::size_t>(tiling.columns) * tiling.rows, 0);
  chunk.per_rank.reserve(end - begin);
  chunk.tiles.reserve(2 * (end - begin));
  for (std::size_t r = begin; r < end; ++r) {
    const Splat& s = splats[r];
    const std::size_t before = chunk.tiles.size();
    const int row0 = floor_div_tile(s.y - s.half_height - 0.5f, tiling.rows - 1), row1 = floor_div_tile(s.y + s.half_height, tiling.rows - 1);
    for (int row = row0; row <= row1; ++row) {
      const Span span = outline_span(s, row * kTile, std::min((row + 1) * kTile, camera.height) - 1, camera.width);
      if (span.last < span.first) continue;
      for (int column = span.first / kTile; column <= span.last / kTile; ++column) {
        const std::uint32_t tile = row * tiling.columns + column;
        chunk.tiles.push_back(tile);
        ++chunk.counts[tile];
      }
    }
    if (chunk.tiles.size() > kMaxPairs) throw std::length_error("render: more than 2^31 tile-Gaussian pairs");
    chunk.per_rank.push_back(static_cast<std::uint32_t>(chunk.tiles.size() - before));
  }
}

}  // namespace

Tiling tile_splats(const Splat* splats, std::size_t count, const Camera& camera, bool with_slots, int threads) {
  Tiling tiling;
  tiling.columns = (camera.width + kTile - 1) / kTile;
  tiling.rows = (camera.height + kTile - 1) / kTile;
  const std::size_t tiles = static_cast<std::size_t>(tiling.columns) * tiling.rows;
  std::vector<Chunk> chunks(kChunks);
  const std::size_t size = (count + kChunks - 1) / kChunks;
  const auto bounds = [&](std::size_t i) { return std::pair(std::min(count, i * size), std::min(count, (i + 1) * size)); };
  parallel_for(kChunks, 1, threads, [&](std::size_t first, std::size_t last) {
    for (std::size_t i = first; i < last; ++i) list_tiles(splats, bounds(i).first, bounds(i).second, camera, tiling, chunks[i]);
  });
  std::uint64_t total = 0;
  for (Chunk& chunk : chunks) {
    chunk.first_pair = static_cast<std::uint32_t>(total);
    total += chunk.tiles.size();
    if (total > kMaxPairs) throw std::length_error("render: more than 2^31 tile-Gaussian pairs");
  }
  tiling.count = static_cast<std::uint32_t>(total);
  tiling.isects = make_buffer<std::uint32_t>(total);
  tiling.tile_offsets.resize(tiles + 1);
  std::uint32_t next = 0;
  for (std::size_t tile = 0; tile < tiles; ++tile) {
    tiling.tile_offsets[tile] = next;
    for (Chunk& chunk : chunks) next += std::exchange(chunk.counts[tile], next);
  }
  tiling.tile_offsets[tiles] = next;
  if (with_slots) {
    tiling.slots = make_buffer<std::uint32_t>(total);
    tiling.rank_offsets = make_buffer<std::uint32_t>(count + 1);
    tiling.rank_offsets[count] = tiling.count;
  }
  parallel_for(kChunks, 1, threads, [&](std::size_t first, std::size_t last) {
    for (std::size_t i = first; i < last; ++i) {
      Chunk& chunk = chunks[i];
      std::size_t pair = 0;
      const auto [begin, end] = bounds(i);
      for (std::size_t r = begin; r < end; ++r) {
        if (with_slots) tiling.rank_offsets[r] = chunk.first_pair + static_cast<std::uint32_t>(pair);
        for (std::uint32_t k = 0; k < chunk.per_rank[r - begin]; ++k, ++pair) {
          const std::uint32_t place = chunk.counts[chunk.tiles[pair]]++;
          tiling.isects[place] = static_cast<std::uint32_t>(r);
          if (with_slots) tiling.slots[chunk.first_pair + pair] = place;
        }
      }
    }
  });
  return tiling;
}

}  // namespace cap4d
