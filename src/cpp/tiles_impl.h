// The templates of tiles.h.
#pragma once
#include <utility>

#include "parallel.h"
#include "tiles.h"

namespace cap4d {

template <class Lookup>
void make_tile_lists(const Drawn* drawn, std::size_t count, std::size_t pairs, Grid grid, bool with_slots, int threads, const Lookup& pairs_of,
                     TileLists& lists) {
  // Ranks are binned in chunks; a tile's list is the chunks' lists one after the other, so their number never shows.
  constexpr std::size_t kChunks = 16, kAhead = 16;
  const std::size_t tiles = grid.count(), size = (count + kChunks - 1) / kChunks;
  std::uint32_t* isects = lists.isects.reserve(pairs);
  std::uint32_t* slots = with_slots ? lists.slots.reserve(pairs) : nullptr;
  std::uint32_t* offsets = lists.offsets.reserve(tiles + 1);
  std::uint32_t* places = lists.places.reserve(kChunks * tiles);  // first counts, then where the chunk's next of the tile goes
  const auto each_tile = [&](const Drawn& d, auto&& visit) {
    if (!d.tiles.is_listed()) return d.tiles.each(grid.columns, visit);
    const PairsOf listed = pairs_of(d.id);
    std::for_each_n(listed.tiles, listed.count, visit);
  };
  const auto each_rank = [&](std::size_t chunk, auto&& visit) {
    for (std::size_t i = std::min(count, chunk * size); i < std::min(count, (chunk + 1) * size); ++i) visit(i);
  };
  parallel_for(kChunks, 1, threads, [&](std::size_t chunk, std::size_t last) {
    for (; chunk < last; ++chunk) {
      std::uint32_t* place = places + chunk * tiles;
      std::fill_n(place, tiles, 0);
      each_rank(chunk, [&](std::size_t i) { each_tile(drawn[i], [&](std::uint32_t tile) { ++place[tile]; }); });
    }
  });
  std::uint32_t next = 0;
  for (std::size_t tile = 0; tile < tiles; ++tile) {
    offsets[tile] = next;
    for (std::size_t chunk = 0; chunk < kChunks; ++chunk) next += std::exchange(places[chunk * tiles + tile], next);
  }
  offsets[tiles] = next;
  parallel_for(kChunks, 1, threads, [&](std::size_t chunk, std::size_t last) {
    for (; chunk < last; ++chunk) {
      std::uint32_t* place = places + chunk * tiles;
      each_rank(chunk, [&](std::size_t i) {
        if (!with_slots) return each_tile(drawn[i], [&](std::uint32_t tile) { isects[place[tile]++] = drawn[i].id; });
        if (i + kAhead < count) pairs_of.prefetch(drawn[i + kAhead].id);
        std::uint32_t pair = pairs_of(drawn[i].id).first;
        each_tile(drawn[i], [&](std::uint32_t tile) {
          const std::uint32_t at = place[tile]++;
          isects[at] = drawn[i].id, slots[at] = pair++;
        });
      });
    }
  });
}

}  // namespace cap4d
