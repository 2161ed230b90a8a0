// Which Gaussians meet which tiles: the exact ellipse where alpha >= 1/255 against rows of tiles; and each tile's list, near to far.
#pragma once
#include <algorithm>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "camera.h"
#include "constants.h"
#include "gaussians.h"
#include "scratch.h"

namespace cap4d {

struct Grid {  // of tiles
  int columns, rows;
  std::size_t count() const { return static_cast<std::size_t>(columns) * rows; }
};

inline Grid grid_of(const Camera& camera) { return {(camera.width + kTile - 1) / kTile, (camera.height + kTile - 1) / kTile}; }

// The tiles that one Gaussian meets, in one word where they lie within 3 x 3: the first tile's column and row, and a bit for each of
// the nine. Nearly all do; the others' tiles stand in a list.
class TileSet {
 public:
  static constexpr int kSide = 3;

  static TileSet small(int column, int row, std::uint32_t mask) { return TileSet(static_cast<std::uint32_t>(column | row << 10) | mask << 20); }
  static TileSet listed() { return TileSet(1u << 31); }
  bool is_listed() const { return word_ >> 31; }
  // Calls visit(tile) in scan order.
  template <class Visit>
  void each(int columns, const Visit& visit) const {
    const std::uint32_t first = (word_ >> 10 & 1023) * columns + (word_ & 1023);
    for (std::uint32_t mask = word_ >> 20; mask; mask &= mask - 1) {
      const int bit = std::countr_zero(mask);
      visit(first + bit / kSide * columns + bit % kSide);
    }
  }
  TileSet() = default;

 private:
  explicit TileSet(std::uint32_t word) : word_(word) {}
  std::uint32_t word_;
};
static_assert(kMaxSide / kTile <= 1024);

// A drawn Gaussian on its way to the tiles' lists; sorted by depth.
struct Drawn {
  std::uint32_t key;  // the depth's bits: positive floats sort as unsigned integers
  std::uint32_t id;
  TileSet tiles;
};

// The tiles of one drawn splat; those of a large one are appended to `list`. `count` is their number.
TileSet tiles_of(const Splat& splat, TileBox box, const Camera& camera, std::vector<std::uint32_t>& list, std::uint32_t& count);

// Each tile's Gaussians, near to far.
struct TileLists {
  Scratch<std::uint32_t> offsets;  // [tiles + 1]
  Scratch<std::uint32_t> isects;   // [pairs] Gaussian
  Scratch<std::uint32_t> slots;    // [pairs] pair; only for the gradient
  Scratch<std::uint32_t> places;   // of the chunks
};

// What a Gaussian's TileSet does not say: its first pair's number, and its tiles where they are listed.
struct PairsOf {
  std::uint32_t first, count;
  const std::uint32_t* tiles;
};

// drawn [count]: the Gaussians near to far; `pairs_of(id)` gives PairsOf, and is asked only where it must be. `slots` may be left out.
template <class Lookup>
void make_tile_lists(const Drawn* drawn, std::size_t count, std::size_t pairs, Grid grid, bool with_slots, int threads, const Lookup& pairs_of,
                     TileLists& lists);

}  // namespace cap4d

#include "tiles_impl.h"
