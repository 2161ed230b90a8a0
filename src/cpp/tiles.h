// Which Gaussians meet which tiles: the exact ellipse where alpha >= 1/255 against rows of tiles; and each tile's list, near to far.
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

template <class T>
using Buffer = std::unique_ptr<T[]>;

template <class T>
Buffer<T> make_buffer(std::size_t n) {  // not initialised
  return std::make_unique_for_overwrite<T[]>(n ? n : 1);
}

struct Grid {  // of tiles
  int columns, rows;
  std::size_t count() const { return static_cast<std::size_t>(columns) * rows; }
};

inline Grid grid_of(const Camera& camera) { return {(camera.width + kTile - 1) / kTile, (camera.height + kTile - 1) / kTile}; }

// A pair is a Gaussian and a tile it meets. Pairs are numbered Gaussian after Gaussian, in the caller's order.
struct Pairs {
  Buffer<std::uint32_t> tiles;    // [count]
  Buffer<std::uint32_t> offsets;  // [N + 1] first pair of each Gaussian
  std::uint32_t count = 0;
};

// The tiles of one drawn splat appended to `tiles`.
void list_tiles(const Splat& splat, TileBox box, const Camera& camera, std::vector<std::uint32_t>& tiles);

// Each tile's Gaussians, near to far.
struct TileLists {
  std::vector<std::uint32_t> offsets;  // [tiles + 1]
  Buffer<std::uint32_t> isects;        // [pairs] Gaussian
  Buffer<std::uint32_t> slots;         // [pairs] pair; only for the gradient
};

// order [drawn]: the Gaussians near to far.
TileLists make_tile_lists(const Pairs& pairs, const std::uint32_t* order, std::size_t drawn, Grid grid, bool with_slots, int threads);

}  // namespace cap4d
