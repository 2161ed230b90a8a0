#include "render.h"

#include <bit>
#include <stdexcept>

#include "parallel.h"
#include "sort.h"

namespace cap4d {
namespace {

constexpr std::size_t kGrain = 1024;  // Gaussians per piece of work
constexpr std::uint64_t kMaxPairs = 1ull << 31;

// One piece of the first stage: what it drew and the tiles of that.
struct Piece {
  std::vector<std::uint32_t> tiles;
  std::vector<std::uint32_t> ids, depths;  // of the drawn; depths as bits: positive floats sort as unsigned integers
  std::uint32_t first_pair = 0, first_drawn = 0;
};

void project_piece(Rendered& r, const GaussiansView& gaussians, std::size_t begin, std::size_t end, Piece& piece) {
  TileBox boxes[kGrain];
  kernels().project_fwd(r.camera, gaussians, begin, end, r.splats.get(), r.radii.get(), boxes);
  piece.ids.reserve(end - begin), piece.depths.reserve(end - begin), piece.tiles.reserve(2 * (end - begin));
  for (std::size_t id = begin; id < end; ++id) {
    r.pairs.offsets[id] = static_cast<std::uint32_t>(piece.tiles.size());  // within the piece, for now
    if (r.radii[id] == 0) continue;
    list_tiles(r.splats[id], boxes[id - begin], r.camera, piece.tiles);
    if (piece.tiles.size() > kMaxPairs) throw std::length_error("render: more than 2^31 tile-Gaussian pairs");
    piece.ids.push_back(static_cast<std::uint32_t>(id));
    piece.depths.push_back(std::bit_cast<std::uint32_t>(r.splats[id].depth));
  }
}

// Splats, radii and pairs of all Gaussians; returns the drawn ones near to far, equal depths in the caller's order.
Buffer<std::uint32_t> project_and_sort(Rendered& r, const GaussiansView& gaussians, int threads) {
  const std::size_t count = gaussians.count;
  r.radii = make_buffer<std::int32_t>(count);
  r.splats = make_buffer<Splat>(count);
  r.pairs.offsets = make_buffer<std::uint32_t>(count + 1);
  std::vector<Piece> pieces((count + kGrain - 1) / kGrain);
  parallel_for(count, kGrain, threads, [&](std::size_t begin, std::size_t end) { project_piece(r, gaussians, begin, end, pieces[begin / kGrain]); });
  std::uint64_t pairs = 0;
  for (Piece& piece : pieces) {
    piece.first_pair = static_cast<std::uint32_t>(pairs), piece.first_drawn = static_cast<std::uint32_t>(r.drawn);
    pairs += piece.tiles.size(), r.drawn += piece.ids.size();
    if (pairs > kMaxPairs) throw std::length_error("render: more than 2^31 tile-Gaussian pairs");
  }
  r.pairs.count = static_cast<std::uint32_t>(pairs);
  r.pairs.tiles = make_buffer<std::uint32_t>(pairs);
  r.pairs.offsets[count] = r.pairs.count;
  auto order = make_buffer<std::uint32_t>(r.drawn), depths = make_buffer<std::uint32_t>(r.drawn), scratch = make_buffer<std::uint32_t>(2 * r.drawn);
  parallel_for(count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    const Piece& piece = pieces[begin / kGrain];
    for (std::size_t id = begin; id < end; ++id) r.pairs.offsets[id] += piece.first_pair;
    std::copy(piece.tiles.begin(), piece.tiles.end(), r.pairs.tiles.get() + piece.first_pair);
    std::copy(piece.ids.begin(), piece.ids.end(), order.get() + piece.first_drawn);
    std::copy(piece.depths.begin(), piece.depths.end(), depths.get() + piece.first_drawn);
  });
  sort_pairs(depths.get(), order.get(), scratch.get(), scratch.get() + r.drawn, r.drawn);
  return order;
}

TileJob tile_job(const Rendered& r, std::size_t tile) {
  const std::uint32_t first = r.lists.offsets[tile];
  const int columns = grid_of(r.camera).columns, row = static_cast<int>(tile) / columns, column = static_cast<int>(tile) % columns;
  return {r.splats.get(), r.lists.isects.get() + first, r.lists.offsets[tile + 1] - first, column * kTile, row * kTile, &r.camera, r.background};
}

}  // namespace

Rendered render_fwd(const Camera& camera, const GaussiansView& gaussians, const float* background, Pass pass, int threads, const Image& image) {
  Rendered r;
  r.camera = camera;
  r.count = gaussians.count;
  for (int c = 0; c < 3; ++c) r.background[c] = background ? background[c] : 0.0f;
  const auto order = project_and_sort(r, gaussians, threads);
  const Grid grid = grid_of(camera);
  r.lists = make_tile_lists(r.pairs, order.get(), r.drawn, grid, pass == Pass::kTrain, threads);
  parallel_for(grid.count(), 1, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t tile = begin; tile < end; ++tile) kernels().rasterize_fwd(tile_job(r, tile), image);
  });
  return r;
}

void render_bwd(const Rendered& r, const GaussiansView& gaussians, const Image& image, const ImageGrad& v_image, int threads,
                const GaussianGrads& grads) {
  auto pair_grads = make_buffer<SplatGrad>(r.pairs.count);
  parallel_for(grid_of(r.camera).count(), 1, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t tile = begin; tile < end; ++tile)
      kernels().rasterize_bwd(tile_job(r, tile), image, v_image, r.lists.slots.get() + r.lists.offsets[tile], pair_grads.get());
  });
  parallel_for(r.count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    kernels().project_bwd(r.camera, gaussians, begin, end, r.radii.get(), {pair_grads.get(), r.pairs.offsets.get()}, grads);
  });
}

}  // namespace cap4d
