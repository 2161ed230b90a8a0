// One tile's pixels from its Gaussians, near to far, and the gradient of that. Compiled once per instruction set.
//
// A tile is cut into blocks of 4 columns by kLanes / 4 rows, one register each. Its list is taken in chunks that fit the first-level
// cache: first the outlines of a chunk are met with the blocks, kLanes Gaussians at a time; then the blocks are drawn. Forward, each
// block walks its own Gaussians with its pixels in registers and leaves when they are finished. Backward, each Gaussian walks its
// blocks, which the forward pass noted, with its sums in registers.
// Both passes go near to far. The gradient needs, for each Gaussian at each pixel, what lies behind it: that is the pixel's
// total less what has been passed, so nothing per pixel has to be kept from the forward pass but its image.
#include <algorithm>
#include <cstddef>
#include <cstring>

#include "constants.h"
#include "kernels.h"
#include "simd.h"

namespace cap4d::CAP4D_ISA {
namespace {

// Blocks are numbered down the columns.
constexpr int kBlockWidth = 4, kBlockHeight = kLanes / kBlockWidth;
constexpr int kBlockColumns = kTile / kBlockWidth, kBands = kTile / kBlockHeight, kBlocks = kBlockColumns * kBands;
static_assert(kBlocks <= 64);

struct Lanes {  // pixel centres of a block, relative to its corner
  float x[kLanes], y[kLanes];
};
constexpr Lanes kPixel = [] {
  Lanes lanes{};
  for (int l = 0; l < kLanes; ++l) lanes.x[l] = l % kBlockWidth + 0.5f, lanes.y[l] = l / kBlockWidth + 0.5f;
  return lanes;
}();

CAP4D_INLINE int block_x(int block) { return block / kBands * kBlockWidth; }
CAP4D_INLINE int block_y(int block) { return block % kBands * kBlockHeight; }

struct Pixel {
  int x, y;
};
CAP4D_INLINE Pixel pixel_of(const TileJob& job, int block, int lane) {
  return {job.x0 + block_x(block) + lane % kBlockWidth, job.y0 + block_y(block) + lane / kBlockWidth};
}

CAP4D_INLINE bool inside(const TileJob& job, Pixel p) { return p.x < job.camera->width && p.y < job.camera->height; }

CAP4D_INLINE bool whole(const TileJob& job) { return job.x0 + kTile <= job.camera->width && job.y0 + kTile <= job.camera->height; }

// Transmittance 1 in the image; outside it a pixel is finished from the start (finished = negative).
BlockSet open_pixels(const TileJob& job, FloatV* transmittance) {
  if (whole(job)) {
    for (int block = 0; block < kBlocks; ++block) transmittance[block] = splat(1.0f);
    return kBlocks == 64 ? ~BlockSet{0} : (BlockSet{1} << kBlocks % 64) - 1;
  }
  BlockSet open = 0;
  for (int block = 0; block < kBlocks; ++block)
    for (int l = 0; l < kLanes; ++l) {
      const bool in = inside(job, pixel_of(job, block, l));
      transmittance[block][l] = in ? 1.0f : -1.0f;
      open |= static_cast<BlockSet>(in) << block;
    }
  return open;
}

// Which of a chunk's Gaussians meet a block: a bit for each.
constexpr int kChunk = 256, kWords = kChunk / 64;
typedef std::uint64_t GaussianSet[kWords];

struct Outlines {  // of kLanes Gaussians; in the order of Splat
  FloatV x, y, half_height, slope, y_rightmost, half_width2, inv_height2;
};

// Splats lie in memory in the caller's order: ask for them before they are needed.
constexpr std::size_t kPrefetch = 2 * kLanes;

CAP4D_INLINE Outlines gather_outlines(const TileJob& job, std::size_t first, int count) {
  const float* rows[kLanes];
  for (int l = 0; l < kLanes; ++l) {
    const std::size_t i = first + (l < count ? l : count - 1);
    if (i + kPrefetch < job.count) __builtin_prefetch(&job.splats[job.isects[i + kPrefetch]]);
    rows[l] = &job.splats[job.isects[i]].x;
  }
  FloatV fields[8];
  load_rows8(rows, fields);
  Outlines outlines;
  static_assert(sizeof outlines == 7 * sizeof(FloatV) && offsetof(Splat, inv_height2) == 6 * sizeof(float));
  std::memcpy(&outlines, fields, sizeof outlines);
  return outlines;
}

// Blocks that an outline meets, exact for their pixel centres' rows and columns: the widest chord of an ellipse within a band is at
// its extreme point, or at the row of the band nearest to that. `note` takes (block, which of the kLanes Gaussians meet it).
template <class Note>
CAP4D_INLINE void meet_blocks(const Outlines& s, int x0, int y0, const Note& note) {
  const FloatV zero = splat(0.0f), x = s.x - static_cast<float>(x0), y = s.y - static_cast<float>(y0);
  for (int band = 0; band < kBands; ++band) {
    const FloatV first_row = (band * kBlockHeight + 0.5f) - y;
    const FloatV low = max(first_row, -s.half_height), high = min(first_row + (kBlockHeight - 1.0f), s.half_height);
    const MaskV crossed = less_equal(low, high);
    const FloatV right = min(max(s.y_rightmost, low), high), left = min(max(-s.y_rightmost, low), high);
    const FloatV half_right = sqrt(s.half_width2 * max(1.0f - right * right * s.inv_height2, zero));
    const FloatV half_left = sqrt(s.half_width2 * max(1.0f - left * left * s.inv_height2, zero));
    const FloatV first = s.slope * left - half_left + x, last = s.slope * right + half_right + x;
    for (int column = 0; column < kBlockColumns; ++column) {
      const float centre = column * kBlockWidth + 0.5f;
      const MaskV met = less_equal_in(less_equal_in(crossed, first, splat(centre + (kBlockWidth - 1))), splat(centre), last);
      note(column * kBands + band, met);
    }
  }
}

// A lane's blocks as its bits, up to 32 in each word; and all of them as sets.
constexpr int kBlockWords = (kBlocks + 31) / 32;
CAP4D_INLINE void put_sets(const IntV* words, int count, BlockSet* sets) {
  typedef std::uint32_t Word __attribute__((vector_size(4 * kLanes)));
  typedef BlockSet Set __attribute__((vector_size(8 * kLanes)));
  Set set{};
  for (int w = 0; w < kBlockWords; ++w) set |= __builtin_convertvector(reinterpret_cast<Word>(words[w]), Set) << 32 * w;
  std::memcpy(sets, &set, count == kLanes ? sizeof set : count * sizeof *sets);
}

// Meets Gaussians [begin, begin + count) of the tile with its blocks. kKeep: and fills in met [count].
template <bool kKeep>
void meet(const TileJob& job, std::size_t begin, int count, GaussianSet* of_block, BlockSet* met_by) {
  std::memset(of_block, 0, kBlocks * sizeof *of_block);
  for (int first = 0; first < count; first += kLanes) {
    const int some = std::min(kLanes, count - first);
    const std::uint32_t real = (1u << some) - 1;
    IntV sets[kBlockWords] = {};
    meet_blocks(gather_outlines(job, begin + first, some), job.x0, job.y0, [&](int block, MaskV met) {
      of_block[block][first / 64] |= std::uint64_t{bits(met) & real} << first % 64;
      if constexpr (kKeep) sets[block / 32] |= keep_int(met, static_cast<std::int32_t>(1u << block % 32));
    });
    if constexpr (kKeep) put_sets(sets, some, met_by + first);
  }
}

// The exponent of alpha at a block's pixels, base 2; never above log2_opacity.
struct Place {
  FloatV dx, u;  // from the centre, sheared
};
CAP4D_INLINE FloatV exponent_at(const Splat& s, FloatV x, FloatV y, Place& at) {
  at.dx = x - s.x;
  at.u = (y - s.y) - s.shear * at.dx;
  return s.c * at.u * at.u + (s.a * at.dx * at.dx + s.log2_opacity);
}

// forward -----------------------------------------------------------------------------------------------------------------------

// Alpha is summed where depth is divided by it: 1 - transmittance has no digits left where little is seen.
template <bool kDepth>
struct BlockSums {
  FloatV transmittance, red, green, blue, alpha, depth;
};
template <>
struct BlockSums<false> {
  FloatV transmittance, red, green, blue;
};

// Draws a chunk into a block; false when its pixels are finished.
template <bool kDepth>
CAP4D_INLINE bool draw_block(const TileJob& job, std::size_t begin, const std::uint64_t* words, int block, BlockSums<kDepth>& sums) {
  const FloatV x = load(kPixel.x) + static_cast<float>(job.x0 + block_x(block)), y = load(kPixel.y) + static_cast<float>(job.y0 + block_y(block));
  BlockSums<kDepth> b = sums;
  MaskV open = less(splat(0.0f), b.transmittance);
  b.transmittance = max(b.transmittance, -b.transmittance);
  bool going = true;
  for (int w = 0; w < kWords && going; ++w)
    for (std::uint64_t word = words[w]; word; word &= word - 1) {
      const Splat& s = job.splats[job.isects[begin + 64 * w + __builtin_ctzll(word)]];
      Place at;
      const FloatV exponent = exponent_at(s, x, y, at);
      const MaskV visible = less_equal_in(open, splat(kLog2AlphaMin), exponent);
      const FloatV alpha = keep(visible, min(exp2_in_range(exponent), splat(kAlphaMax)));
      FloatV weight = alpha * b.transmittance, next = b.transmittance - weight;
      const MaskV stop = less(next, splat(kTransmittanceMin));  // an open pixel: what is finished stands above
      if (any(stop)) [[unlikely]] {
        open = first_only(open, stop);
        weight = select(stop, splat(0.0f), weight);
        next = select(stop, b.transmittance, next);
        going = any(open);
      }
      b.red += weight * s.red;
      b.green += weight * s.green;
      b.blue += weight * s.blue;
      if constexpr (kDepth) {
        b.alpha += weight;
        b.depth += weight * s.depth;
      }
      b.transmittance = next;
      if (!going) break;
    }
  sums = b;
  sums.transmittance = select(open, b.transmittance, -b.transmittance);
  return going;
}

// met [job.count] where kKeep.
template <bool kDepth, bool kKeep>
void draw_tile(const TileJob& job, BlockSums<kDepth>* sums, BlockSet* met) {
  FloatV transmittance[kBlocks];
  BlockSet open = open_pixels(job, transmittance);
  for (int block = 0; block < kBlocks; ++block) sums[block] = BlockSums<kDepth>{}, sums[block].transmittance = transmittance[block];
  GaussianSet gaussians[kBlocks];
  std::size_t begin = 0;
  for (; begin < job.count && open; begin += kChunk) {
    meet<kKeep>(job, begin, static_cast<int>(std::min<std::size_t>(kChunk, job.count - begin)), gaussians, kKeep ? met + begin : nullptr);
    for (BlockSet todo = open; todo; todo &= todo - 1) {
      const int block = __builtin_ctzll(todo);
      if (!draw_block<kDepth>(job, begin, gaussians[block], block, sums[block])) open &= ~(BlockSet{1} << block);
    }
  }
  if (kKeep && begin < job.count) std::fill(met + begin, met + job.count, BlockSet{0});
  for (int block = 0; block < kBlocks; ++block) sums[block].transmittance = max(sums[block].transmittance, -sums[block].transmittance);
}

// Calls write(pixel's index in the image, lane) for the pixels of a block that are in the image.
template <class Write>
CAP4D_INLINE void each_pixel(const TileJob& job, int block, const Write& write) {
  const std::size_t width = job.camera->width;
  if (whole(job)) {
    const std::size_t corner = (job.y0 + block_y(block)) * width + job.x0 + block_x(block);
    for (int l = 0; l < kLanes; ++l) write(corner + l / kBlockWidth * width + l % kBlockWidth, l);
    return;
  }
  for (int l = 0; l < kLanes; ++l) {
    const Pixel p = pixel_of(job, block, l);
    if (inside(job, p)) write(p.y * width + p.x, l);
  }
}

}  // namespace

void rasterize_fwd(const TileJob& job, const Image& image, BlockSet* met) {
  BlockSums<true> sums[kBlocks];
  if (met) draw_tile<true, true>(job, sums, met);
  else draw_tile<true, false>(job, sums, met);
  for (int block = 0; block < kBlocks; ++block) {
    const BlockSums<true>& b = sums[block];
    const FloatV depth = keep(less(splat(0.0f), b.alpha), b.depth / b.alpha);
    const float* background = job.background;
    float rgb[3][kLanes], alphas[kLanes], depths[kLanes];
    store(rgb[0], b.red + b.transmittance * background[0]);
    store(rgb[1], b.green + b.transmittance * background[1]);
    store(rgb[2], b.blue + b.transmittance * background[2]);
    store(alphas, min(b.alpha, splat(1.0f)));
    store(depths, depth);
    each_pixel(job, block, [&](std::size_t at, int l) {
      for (int c = 0; c < 3; ++c) image.rgb[3 * at + c] = rgb[c][l];
      image.alpha[at] = alphas[l];
      image.depth[at] = depths[l];
    });
  }
}

namespace {

// [0, 1] -> 0 to 255, rounded; what is outside is clamped.
CAP4D_INLINE IntV byte_of(FloatV v) {
  return __builtin_convertvector(min(max(v, splat(0.0f)), splat(1.0f)) * 255.0f + 0.5f, IntV);
}

}  // namespace

void rasterize_rgba8(const TileJob& job, const Image8& image) {
  BlockSums<false> sums[kBlocks];
  draw_tile<false, false>(job, sums, nullptr);
  for (int block = 0; block < kBlocks; ++block) {
    const BlockSums<false>& b = sums[block];
    FloatV color[3] = {b.red, b.green, b.blue}, alpha = splat(1.0f);
    if (image.alpha == Alpha::kOpaque) {
      for (int c = 0; c < 3; ++c) color[c] = color[c] + b.transmittance * job.background[c];
    } else {
      alpha = 1.0f - b.transmittance;
      if (image.alpha == Alpha::kStraight)
        for (FloatV& c : color) c = c / max(alpha, splat(1e-6f));
    }
    const IntV packed = byte_of(color[0]) | byte_of(color[1]) << 8 | byte_of(color[2]) << 16 | byte_of(alpha) << 24;
    std::uint32_t pixels[kLanes];
    std::memcpy(pixels, &packed, sizeof pixels);
    each_pixel(job, block, [&](std::size_t at, int l) { std::memcpy(image.rgba + 4 * at, &pixels[l], 4); });
  }
}

// Adds a chunk's Gaussians at a block's pixels: those that `draw_block` would take if nothing were hidden.
CAP4D_INLINE IntV count_block(const TileJob& job, std::size_t begin, const std::uint64_t* words, int block) {
  const FloatV x = load(kPixel.x) + static_cast<float>(job.x0 + block_x(block)), y = load(kPixel.y) + static_cast<float>(job.y0 + block_y(block));
  IntV sum = {};
  for (int w = 0; w < kWords; ++w)
    for (std::uint64_t word = words[w]; word; word &= word - 1) {
      Place at;
      const FloatV exponent = exponent_at(job.splats[job.isects[begin + 64 * w + __builtin_ctzll(word)]], x, y, at);
      sum += keep_int(less_equal(splat(kLog2AlphaMin), exponent), 1);
    }
  return sum;
}

void count_gaussians(const TileJob& job, std::uint16_t* counts) {
  IntV sums[kBlocks] = {};
  GaussianSet gaussians[kBlocks];
  for (std::size_t begin = 0; begin < job.count; begin += kChunk) {
    meet<false>(job, begin, static_cast<int>(std::min<std::size_t>(kChunk, job.count - begin)), gaussians, nullptr);
    for (int block = 0; block < kBlocks; ++block) sums[block] += count_block(job, begin, gaussians[block], block);
  }
  for (int block = 0; block < kBlocks; ++block)
    each_pixel(job, block, [&](std::size_t at, int l) { counts[at] = static_cast<std::uint16_t>(std::min<std::int32_t>(sums[block][l], UINT16_MAX)); });
}

// backward ----------------------------------------------------------------------------------------------------------------------

namespace {

struct Contribution {  // of one Gaussian to the pixels of one block
  FloatV alpha, density, weight, next;
  Place at;
  MaskV visible;  // alpha >= 1/255, the pixel open, and not finished by this one
  bool stops;     // some pixel is
};

// False where nothing of the block is visible. x, y: the block's pixel centres.
CAP4D_INLINE bool contribute(const Splat& s, FloatV x, FloatV y, FloatV transmittance, Contribution& c) {
  const FloatV exponent = exponent_at(s, x, y, c.at);
  c.visible = less_equal_in(less(splat(0.0f), transmittance), splat(kLog2AlphaMin), exponent);
  if (!any(c.visible)) return false;
  c.density = exp2_in_range(exponent);
  c.alpha = keep(c.visible, min(c.density, splat(kAlphaMax)));
  c.weight = c.alpha * transmittance;
  c.next = transmittance - c.weight;
  const MaskV stop = both(c.visible, less(c.next, splat(kTransmittanceMin)));
  c.stops = any(stop);
  if (c.stops) [[unlikely]] {
    c.visible = first_only(c.visible, stop);
    c.weight = keep(c.visible, c.weight);
    c.next = select(stop, -transmittance, c.next);
  }
  return true;
}

CAP4D_INLINE bool finished(FloatV transmittance) { return !any(less(splat(0.0f), transmittance)); }

struct PixelGrads {  // dL/d of what a pixel accumulates: per Gaussian it adds weight * (rgb . c + constant + depth * z)
  FloatV red[kBlocks], green[kBlocks], blue[kBlocks], depth[kBlocks], constant[kBlocks];
  FloatV behind[kBlocks];  // the pixel's total of that, less what has been passed
  FloatV x[kBlocks], y[kBlocks];  // its centre, px
};

// kComponents floats a pixel, block by block; zero outside the image.
template <int kComponents>
using Blocks = float[kBlocks][kComponents * kLanes];

template <int kComponents>
void gather_pixels(const TileJob& job, const float* image, Blocks<kComponents>& blocks) {
  const std::size_t width = job.camera->width;
  if (!whole(job)) std::memset(blocks, 0, sizeof blocks);
  for (int block = 0; block < kBlocks; ++block) {
    const std::size_t corner = (job.y0 + block_y(block)) * width + job.x0 + block_x(block);
    constexpr std::size_t kRow = kComponents * kBlockWidth;
    if (whole(job))
      for (int row = 0; row < kBlockHeight; ++row) std::memcpy(blocks[block] + row * kRow, image + kComponents * (corner + row * width), kRow * sizeof(float));
    else
      each_pixel(job, block, [&](std::size_t at, int l) { std::copy_n(image + kComponents * at, kComponents, blocks[block] + kComponents * l); });
  }
}

struct TilePixels {  // what the forward pass made of a tile's pixels and what the loss says of them; alpha and depth where it says anything
  Blocks<3> rgb, v_rgb;
  Blocks<1> alpha, depth, v_alpha, v_depth;
};

void load_pixels(const TileJob& job, const Image& image, const ImageGrad& v, TilePixels& pixels) {
  gather_pixels<3>(job, image.rgb, pixels.rgb), gather_pixels<3>(job, v.rgb, pixels.v_rgb);
  gather_pixels<1>(job, image.alpha, pixels.alpha);
  if (v.alpha) gather_pixels<1>(job, v.alpha, pixels.v_alpha);
  if (v.depth) gather_pixels<1>(job, image.depth, pixels.depth), gather_pixels<1>(job, v.depth, pixels.v_depth);
}

void load_pixel_grads(const TileJob& job, const Image& image, const ImageGrad& v, PixelGrads& grads) {
  TilePixels pixels;
  load_pixels(job, image, v, pixels);
  for (int block = 0; block < kBlocks; ++block) {
    FloatV rgb[3], v_rgb[3], constant{}, foreground{}, v_depth{};
    deinterleave<3>(pixels.rgb[block], rgb), deinterleave<3>(pixels.v_rgb[block], v_rgb);
    const FloatV alpha = load(pixels.alpha[block]);
    if (v.alpha) constant = load(pixels.v_alpha[block]);
    if (v.depth) {  // depth = accumulated / alpha
      const FloatV depth = load(pixels.depth[block]);
      v_depth = keep(less(splat(0.0f), alpha), load(pixels.v_depth[block]) / alpha);
      constant -= v_depth * depth;
      foreground = v_depth * depth * alpha;
    }
    for (int c = 0; c < 3; ++c) {  // rgb = accumulated + (1 - alpha) background
      const float background = job.background[c];
      constant -= v_rgb[c] * background;
      foreground += v_rgb[c] * (rgb[c] - background + background * alpha);
    }
    foreground += constant * alpha;
    grads.red[block] = v_rgb[0], grads.green[block] = v_rgb[1], grads.blue[block] = v_rgb[2];
    grads.depth[block] = v_depth, grads.constant[block] = constant, grads.behind[block] = foreground;
    grads.x[block] = load(kPixel.x) + static_cast<float>(job.x0 + block_x(block));
    grads.y[block] = load(kPixel.y) + static_cast<float>(job.y0 + block_y(block));
  }
}

// The pairs lie in the order of the caller's Gaussians, which is none here: their lines are fetched before they are written.
constexpr std::size_t kPrefetchGrads = 8;

template <bool kDepth>
void rasterize_tile_bwd(const TileJob& job, PixelGrads& grads, const BlockSet* met, const std::uint32_t* slots, SplatGrad* pair_grads) {
  FloatV transmittance[kBlocks];
  BlockSet open = open_pixels(job, transmittance);
  for (std::size_t i = 0; i < job.count; ++i) {
    if (i + kPrefetch < job.count) __builtin_prefetch(&job.splats[job.isects[i + kPrefetch]]);
    if (i + kPrefetchGrads < job.count) __builtin_prefetch(&pair_grads[slots[i + kPrefetchGrads]], 1);
    const Splat& s = job.splats[job.isects[i]];
    BlockSet todo = open & met[i];
    FloatV v_red{}, v_green{}, v_blue{}, v_depth{}, v_s{}, v_sx{}, v_su{}, v_sxx{}, v_sxu{}, v_suu{};
    bool touched = false;
    for (; todo; todo &= todo - 1) {
      const int block = __builtin_ctzll(todo);
      Contribution c;
      if (!contribute(s, grads.x[block], grads.y[block], transmittance[block], c)) continue;
      touched = true;
      FloatV value = grads.red[block] * s.red + grads.green[block] * s.green + grads.blue[block] * s.blue + grads.constant[block];
      if constexpr (kDepth) value += grads.depth[block] * s.depth;
      const FloatV own = c.weight * value, behind = grads.behind[block] - own;
      // dL/d(ln alpha) = weight * value - alpha / (1 - alpha) * behind, where this one is drawn and not clamped.
      const MaskV moves = both(c.visible, less(c.density, splat(kAlphaMax)));
      const FloatV ds = keep(moves, own - behind * (c.alpha * reciprocal(1.0f - c.alpha)));
      v_red += c.weight * grads.red[block];
      v_green += c.weight * grads.green[block];
      v_blue += c.weight * grads.blue[block];
      if constexpr (kDepth) v_depth += c.weight * grads.depth[block];
      const FloatV sx = ds * c.at.dx, su = ds * c.at.u;
      v_s += ds;
      v_sx += sx;
      v_su += su;
      v_sxx += sx * c.at.dx;
      v_sxu += sx * c.at.u;
      v_suu += su * c.at.u;
      grads.behind[block] = behind;
      transmittance[block] = c.next;
      if (c.stops && finished(c.next)) open &= ~(BlockSet{1} << block);
    }
    // Straight into memory: read back in wider pieces it would wait for the stores.
    float* out = &pair_grads[slots[i]].red;
    if (!touched) {
      pair_grads[slots[i]] = SplatGrad{};
      continue;
    }
    const Float4 color = load4(&s.red);  // clamped at 0: the coefficients of a channel that is 0 move nothing; depth is positive
    store4(out, positive_only(color, sums4(fold4(v_red), fold4(v_green), fold4(v_blue), fold4(v_depth))));
    store4(out + 4, sums4(fold4(v_s), fold4(v_sx), fold4(v_su), fold4(v_sxx)));
    store4(out + 8, sums4(fold4(v_sxu), fold4(v_suu), Float4{}, Float4{}));
  }
}

}  // namespace

void rasterize_bwd(const TileJob& job, const Image& image, const ImageGrad& v, const BlockSet* met, const std::uint32_t* slots,
                   SplatGrad* pair_grads) {
  PixelGrads grads;
  load_pixel_grads(job, image, v, grads);
  if (v.depth)
    rasterize_tile_bwd<true>(job, grads, met, slots, pair_grads);
  else
    rasterize_tile_bwd<false>(job, grads, met, slots, pair_grads);
}

}  // namespace cap4d::CAP4D_ISA
