#include "render.h"

#include <bit>
#include <utility>

#include "parallel.h"
#include "sort.h"

namespace cap4d {
namespace {

constexpr std::size_t kGrain = 2048;      // Gaussians per piece of work
constexpr std::size_t kTileGrain = 1;

TileJob tile_job(const Rendered& rendered, std::size_t tile) {
  const Tiling& t = rendered.tiling;
  const std::uint32_t first = t.tile_offsets[tile];
  const int row = static_cast<int>(tile) / t.columns, column = static_cast<int>(tile) % t.columns;
  return {rendered.splats.get(), t.isects.get() + first, t.tile_offsets[tile + 1] - first, column * kTile, row * kTile, &rendered.camera,
          rendered.background};
}

// ids of drawn Gaussians near to far; equal depths in the caller's order. Returns their number.
std::size_t order_by_depth(const Splat* splats, const std::int32_t* radii, std::size_t count, std::uint32_t* ids) {
  auto keys = make_buffer<std::uint32_t>(count), scratch = make_buffer<std::uint32_t>(2 * count);
  std::size_t drawn = 0;
  for (std::size_t i = 0; i < count; ++i) {
    if (radii[i] == 0) continue;
    keys[drawn] = std::bit_cast<std::uint32_t>(splats[i].depth);  // positive floats sort as their bits
    ids[drawn++] = static_cast<std::uint32_t>(i);
  }
  sort_pairs(keys.get(), ids, scratch.get(), scratch.get() + count, drawn);
  return drawn;
}

}  // namespace

Rendered render_fwd(const Camera& camera, const GaussiansView& gaussians, const float* background, Pass pass, int threads, const Image& image) {
  const std::size_t count = gaussians.count;
  const bool train = pass == Pass::kTrain;
  Rendered r;
  r.camera = camera;
  r.count = count;
  for (int c = 0; c < 3; ++c) r.background[c] = background ? background[c] : 0.0f;
  r.radii = make_buffer<std::int32_t>(count);
  auto unsorted = make_buffer<Splat>(count);
  parallel_for(count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    kernels().project_fwd(camera, gaussians, begin, end, unsorted.get(), r.radii.get());
  });
  auto ids = make_buffer<std::uint32_t>(count);
  r.drawn = order_by_depth(unsorted.get(), r.radii.get(), count, ids.get());
  r.splats = make_buffer<Splat>(r.drawn);
  if (train) r.ranks = make_buffer<std::uint32_t>(count);
  parallel_for(r.drawn, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t rank = begin; rank < end; ++rank) {
      r.splats[rank] = unsorted[ids[rank]];
      if (train) r.ranks[ids[rank]] = static_cast<std::uint32_t>(rank);
    }
  });
  r.tiling = tile_splats(r.splats.get(), r.drawn, camera, train, threads);
  parallel_for(r.tiling.tile_offsets.size() - 1, kTileGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t tile = begin; tile < end; ++tile) kernels().rasterize_fwd(tile_job(r, tile), image);
  });
  return r;
}

void render_bwd(const Rendered& r, const GaussiansView& gaussians, const Image& image, const ImageGrad& v_image, int threads,
                const GaussianGrads& grads) {
  auto isect_grads = make_buffer<SplatGrad>(r.tiling.count);
  parallel_for(r.tiling.tile_offsets.size() - 1, kTileGrain, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t tile = begin; tile < end; ++tile)
      kernels().rasterize_bwd(tile_job(r, tile), image, v_image, isect_grads.get() + r.tiling.tile_offsets[tile]);
  });
  const GradSlots slots{isect_grads.get(), r.tiling.slots.get(), r.tiling.rank_offsets.get(), r.ranks.get()};
  parallel_for(r.count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    kernels().project_bwd(r.camera, gaussians, begin, end, r.radii.get(), slots, grads);
  });
}

}  // namespace cap4d
