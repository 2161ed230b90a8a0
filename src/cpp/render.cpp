#include "render.h"

#include <bit>
#include <chrono>
#include <stdexcept>

#include "parallel.h"

namespace cap4d {
namespace {

constexpr std::size_t kGrain = 1024;  // Gaussians per piece of work
constexpr std::uint64_t kMaxPairs = 1ull << 31;

class Stopwatch {
 public:
  double lap() {  // s since the last, or since it was made
    const Clock::time_point now = Clock::now();
    return std::chrono::duration<double>(now - std::exchange(last_, now)).count();
  }

 private:
  using Clock = std::chrono::steady_clock;
  Clock::time_point last_ = Clock::now();
};

// Splats and tiles of Gaussians [begin, end); those drawn are noted from `order[begin]` on.
template <class Project>
void project_piece(Rendered& r, const Project& project, std::size_t begin, std::size_t end, Piece& piece) {
  TileBox boxes[kGrain];
  project(begin, end, boxes);
  piece.tiles.clear();
  Drawn* next = &r.order[begin];
  std::uint32_t pairs = 0;
  for (std::size_t id = begin; id < end; ++id) {
    if (r.radii[id] == 0) continue;
    const auto listed = static_cast<std::uint32_t>(piece.tiles.size());
    std::uint32_t count;
    const TileSet tiles = tiles_of(r.splats[id], boxes[id - begin], r.camera, piece.tiles, count);
    *next++ = {std::bit_cast<std::uint32_t>(r.splats[id].depth), static_cast<std::uint32_t>(id), tiles};
    r.runs[id] = {pairs, count, listed};
    pairs += count;
    if (pairs > kMaxPairs) throw std::length_error("render: more than 2^31 tile-Gaussian pairs");
  }
  piece.drawn = static_cast<std::uint32_t>(next - &r.order[begin]);
  piece.pairs = pairs;
}

// Numbers the pieces' pairs and closes the gaps between what they drew.
void join_pieces(Rendered& r) {
  std::uint64_t pairs = 0;
  r.drawn = 0;
  for (std::size_t k = 0; k < r.pieces.size(); ++k) {
    Piece& piece = r.pieces[k];
    piece.first_pair = pairs;
    if (r.drawn != k * kGrain) std::copy_n(&r.order[k * kGrain], piece.drawn, &r.order[r.drawn]);
    pairs += piece.pairs, r.drawn += piece.drawn;
    if (pairs > kMaxPairs) throw std::length_error("render: more than 2^31 tile-Gaussian pairs");
  }
  r.pairs = static_cast<std::uint32_t>(pairs);
}

// project(begin, end, boxes) fills the splats, radii and boxes of a piece.
template <class Project>
void project_all(Rendered& r, std::size_t count, int threads, const Project& project) {
  r.count = count;
  r.radii.reserve(count), r.splats.reserve(count), r.runs.reserve(count), r.order.reserve(count);
  r.pieces.resize((count + kGrain - 1) / kGrain);
  parallel_for(count, kGrain, threads, [&](std::size_t begin, std::size_t end) { project_piece(r, project, begin, end, r.pieces[begin / kGrain]); });
  join_pieces(r);
}

struct PairLookup {
  const Rendered& r;

  PairsOf operator()(std::uint32_t id) const {
    const Piece& piece = r.pieces[id / kGrain];
    const PairRun& run = r.runs[id];
    return {static_cast<std::uint32_t>(piece.first_pair) + run.first, run.count, piece.tiles.data() + run.listed};
  }
  void prefetch(std::uint32_t id) const { __builtin_prefetch(&r.runs[id]); }
};

TileJob tile_job(const Rendered& r, std::size_t tile) {
  const std::uint32_t first = r.lists.offsets[tile];
  const int columns = grid_of(r.camera).columns, row = static_cast<int>(tile) / columns, column = static_cast<int>(tile) % columns;
  return {r.splats.get(), r.lists.isects.get() + first, r.lists.offsets[tile + 1] - first, column * kTile, row * kTile, &r.camera, r.background};
}

// From what was projected to each tile's list.
void list_tiles(Rendered& r, Pass pass, int threads) {
  Stopwatch watch;
  const Drawn* drawn = sort_by_key(r.order.get(), r.drawn, r.sorting, threads);  // near to far, equal depths in the caller's order
  r.seconds.sort = watch.lap();
  make_tile_lists(drawn, r.drawn, r.pairs, grid_of(r.camera), pass == Pass::kTrain, threads, PairLookup{r}, r.lists);
  r.seconds.tiles = watch.lap();
}

// draw(the tile's job, its first place in the lists)
template <class Draw>
void each_tile(Rendered& r, int threads, const Draw& draw) {
  Stopwatch watch;
  parallel_for(grid_of(r.camera).count(), 1, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t tile = begin; tile < end; ++tile) draw(tile_job(r, tile), r.lists.offsets[tile]);
  });
  r.seconds.rasterize = watch.lap();
}

void begin_frame(Rendered& r, const Camera& camera, const float* background) {
  r.camera = camera;
  for (int c = 0; c < 3; ++c) r.background[c] = background ? background[c] : 0.0f;
}

}  // namespace

std::size_t Rendered::bytes() const {
  std::size_t listed = 0;
  for (const Piece& piece : pieces) listed += piece.tiles.capacity() * sizeof(std::uint32_t);
  return radii.bytes() + splats.bytes() + runs.bytes() + order.bytes() + sorting.records.bytes() + sorting.places.bytes() + lists.offsets.bytes() +
         lists.isects.bytes() + lists.slots.bytes() + lists.places.bytes() + met.bytes() + pieces.capacity() * sizeof(Piece) + listed;
}

void render_fwd(const Camera& camera, const GaussiansView& gaussians, const float* background, Pass pass, int threads, const Image& image,
                Rendered& r) {
  Stopwatch watch;
  begin_frame(r, camera, background);
  project_all(r, gaussians.count, threads, [&](std::size_t begin, std::size_t end, TileBox* boxes) {
    kernels().project_fwd(r.camera, gaussians, begin, end, r.splats.get(), r.radii.get(), boxes);
  });
  r.seconds.project = watch.lap();
  list_tiles(r, pass, threads);
  BlockSet* met = pass == Pass::kTrain ? r.met.reserve(r.pairs) : nullptr;
  each_tile(r, threads, [&](const TileJob& job, std::uint32_t first) { kernels().rasterize_fwd(job, image, met ? met + first : nullptr); });
}

void Splatter::place_frames(const float* vertices, int threads) {
  if (!packed_.bound()) return;
  frames_.reserve(packed_.faces_count);
  parallel_for(packed_.faces_count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    kernels().triangle_frames(vertices, packed_.faces.get(), begin, end, frames_.get());
  });
}

void Splatter::order(const double* viewmat, const float* vertices, int threads, std::uint32_t* order) {
  Stopwatch watch;
  place_frames(vertices, threads);
  rendered_.seconds.frames = watch.lap();
  const double forward[3] = {viewmat[8], viewmat[9], viewmat[10]}, offset = viewmat[11];
  sort_depths(packed_.count, order, threads, [&](std::size_t i) {
    const PackedFloats* mean = &packed_.shape[i / kPack * kPackedFields + kPackedMean];
    const float at[3] = {mean[0].lane[i % kPack], mean[1].lane[i % kPack], mean[2].lane[i % kPack]};
    const TriangleFrame* f = packed_.bound() ? &frames_[packed_.binding[i]] : nullptr;
    double depth = offset;  // in double: far from the origin the sum cancels
    for (int r = 0; r < 3; ++r)
      depth += forward[r] * (f ? f->turn[3 * r] * at[0] + f->turn[3 * r + 1] * at[1] + f->turn[3 * r + 2] * at[2] + f->centre[r] : at[r]);
    return static_cast<float>(depth);
  });
  rendered_.seconds.sort = watch.lap();
}

void Splatter::prepare(const View& view, int threads) {
  Rendered& r = rendered_;
  Stopwatch watch;
  begin_frame(r, view.camera, view.background);
  place_frames(view.vertices, threads);
  r.seconds.frames = watch.lap();
  project_all(r, packed_.count, threads, [&](std::size_t begin, std::size_t end, TileBox* boxes) {
    kernels().project_packed(r.camera, packed_, frames_.get(), begin, end, r.splats.get(), r.radii.get(), boxes);
  });
  r.seconds.project = watch.lap();
  list_tiles(r, Pass::kPlay, threads);
}

void Splatter::draw(const View& view, int threads, const Image& image) {
  prepare(view, threads);
  each_tile(rendered_, threads, [&](const TileJob& job, std::uint32_t) { kernels().rasterize_fwd(job, image, nullptr); });
}

void Splatter::draw(const View& view, int threads, const Image8& image) {
  prepare(view, threads);
  each_tile(rendered_, threads, [&](const TileJob& job, std::uint32_t) { kernels().rasterize_rgba8(job, image); });
}

void Splatter::count(int threads, std::uint16_t* counts) {
  each_tile(rendered_, threads, [&](const TileJob& job, std::uint32_t) { kernels().count_gaussians(job, counts); });
}

void render_bwd(const Rendered& r, const GaussiansView& gaussians, const Image& image, const ImageGrad& v_image, int threads,
                const GaussianGrads& grads) {
  auto pair_grads = make_pages<SplatGrad>(r.pairs);
  parallel_for(grid_of(r.camera).count(), 1, threads, [&](std::size_t begin, std::size_t end) {
    for (std::size_t tile = begin; tile < end; ++tile) {
      const std::uint32_t first = r.lists.offsets[tile];
      kernels().rasterize_bwd(tile_job(r, tile), image, v_image, r.met.get() + first, r.lists.slots.get() + first, pair_grads.get());
    }
  });
  parallel_for(r.count, kGrain, threads, [&](std::size_t begin, std::size_t end) {
    const PairGrads pairs{pair_grads.get() + r.pieces[begin / kGrain].first_pair, r.runs.get()};
    kernels().project_bwd(r.camera, gaussians, begin, end, r.radii.get(), pairs, grads);
  });
}

}  // namespace cap4d
