// One tile's pixels from its Gaussians, near to far, and the gradient of that. Compiled once per instruction set.
//
// A tile is cut into blocks of 4 columns by kLanes / 4 rows, one register each; the tile's state stays in the first-level cache.
// Gaussians are the outer loop: each touches only the blocks that its outline meets and that are not finished.
// Both passes walk near to far. The gradient needs, for each Gaussian at each pixel, what lies behind it: that is the pixel's
// total less what has been passed, so nothing per pixel has to be kept from the forward pass but its image.
#include <algorithm>
#include <cstring>

#include "constants.h"
#include "kernels.h"
#include "simd.h"

namespace cap4d::CAP4D_ISA {
namespace {

// Blocks are numbered down the columns, so that one register holds the bands of a column (or of several).
constexpr int kBlockWidth = 4, kBlockHeight = kLanes / kBlockWidth;
constexpr int kBlockColumns = kTile / kBlockWidth, kBands = kTile / kBlockHeight, kBlocks = kBlockColumns * kBands;
static_assert(kBlocks <= 64);

// Bit i: block i is not finished, or is touched.
typedef std::uint64_t BlockSet;

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

// Transmittance 1 in the image; outside it a pixel is finished from the start (finished = negative).
BlockSet open_pixels(const TileJob& job, FloatV* transmittance) {
  BlockSet open = 0;
  for (int block = 0; block < kBlocks; ++block)
    for (int l = 0; l < kLanes; ++l) {
      const bool in = inside(job, pixel_of(job, block, l));
      transmittance[block][l] = in ? 1.0f : -1.0f;
      open |= static_cast<BlockSet>(in) << block;
    }
  return open;
}

struct Bands {  // first pixel centre of the band and of the column of block l, relative to the tile
  float y[kLanes], x[kLanes];
};
constexpr Bands kBand = [] {
  Bands bands{};
  for (int l = 0; l < kLanes; ++l) bands.y[l] = l % kBands * kBlockHeight + 0.5f, bands.x[l] = l / kBands * kBlockWidth + 0.5f;
  return bands;
}();

// Blocks that the outline of `s` meets, exact for their pixel centres' rows and columns: the widest chord of an ellipse within a
// band is at its extreme point, or at the row of the band nearest to that.
CAP4D_INLINE BlockSet touched_blocks(const Splat& s, int x0, int y0) {
  constexpr int kColumnsAtOnce = kLanes > kBands ? kLanes / kBands : 1, kGroups = kBands > kLanes ? kBands / kLanes : 1;
  BlockSet touched = 0;
  const FloatV height = splat(s.half_height), rightmost = splat(s.y_rightmost), zero = splat(0.0f);
  const float x = s.x - x0, y = s.y - y0;
  for (int group = 0; group < kGroups; ++group) {
    const FloatV first_row = load(kBand.y) + (group * kLanes * kBlockHeight - y);
    const FloatV low = max(first_row, -height), high = min(first_row + (kBlockHeight - 1.0f), height);
    const MaskV crossed = less_equal(low, high);
    const FloatV right = min(max(rightmost, low), high), left = min(max(-rightmost, low), high);
    const FloatV half_right = sqrt(s.half_width2 * max(1.0f - right * right * s.inv_height2, zero));
    const FloatV half_left = sqrt(s.half_width2 * max(1.0f - left * left * s.inv_height2, zero));
    const FloatV first = s.slope * left - half_left + x, last = s.slope * right + half_right + x;
    for (int column = 0; column < kBlockColumns; column += kColumnsAtOnce) {
      const FloatV centre = load(kBand.x) + column * static_cast<float>(kBlockWidth);
      const MaskV met = both(crossed, both(less_equal(first, centre + (kBlockWidth - 1.0f)), less_equal(centre, last)));
      touched |= static_cast<BlockSet>(bits(met)) << (column * kBands + group * kLanes);
    }
  }
  return touched;
}

struct Contribution {  // of one Gaussian to the pixels of one block
  FloatV dx, u, alpha, density, weight, next;
  MaskV visible, stop;
};

// False where nothing of the block is visible. `visible`: alpha >= 1/255 and the pixel open; `stop`: this one would finish it.
CAP4D_INLINE bool contribute(const Splat& s, const TileJob& job, int block, FloatV transmittance, Contribution& c) {
  c.dx = load(kPixel.x) + (job.x0 + block_x(block) - s.x);
  c.u = load(kPixel.y) + (job.y0 + block_y(block) - s.y) - s.shear * c.dx;
  const FloatV exponent = s.c * c.u * c.u + (s.a * c.dx * c.dx + s.log2_opacity);  // never above log2_opacity
  c.visible = both(less_equal(splat(kLog2AlphaMin), exponent), less(splat(0.0f), transmittance));
  if (!any(c.visible)) return false;
  c.density = exp2_nonpositive(exponent);
  c.alpha = min(c.density, splat(kAlphaMax));
  c.weight = c.alpha * transmittance;
  c.next = transmittance - c.weight;
  c.stop = both(c.visible, less(c.next, splat(kTransmittanceMin)));
  c.weight = keep(first_only(c.visible, c.stop), c.weight);
  c.next = select(c.stop, -transmittance, select(c.visible, c.next, transmittance));
  return true;
}

// Splats lie in memory in the caller's order: ask for them before they are needed.
constexpr std::size_t kPrefetch = 12;
CAP4D_INLINE const Splat& splat_at(const TileJob& job, std::size_t i) {
  if (i + kPrefetch < job.count) __builtin_prefetch(&job.splats[job.isects[i + kPrefetch]]);
  return job.splats[job.isects[i]];
}

CAP4D_INLINE bool finished(FloatV transmittance) { return !any(less(splat(0.0f), transmittance)); }

}  // namespace

void rasterize_fwd(const TileJob& job, const Image& image) {
  // Alpha is summed: 1 - transmittance has no digits left where little is seen, and depth is divided by it.
  FloatV transmittance[kBlocks], red[kBlocks] = {}, green[kBlocks] = {}, blue[kBlocks] = {}, alpha[kBlocks] = {}, depth[kBlocks] = {};
  BlockSet open = open_pixels(job, transmittance);
  for (std::size_t i = 0; i < job.count && open; ++i) {
    const Splat& s = splat_at(job, i);
    for (BlockSet todo = open & touched_blocks(s, job.x0, job.y0); todo; todo &= todo - 1) {
      const int block = __builtin_ctzll(todo);
      Contribution c;
      if (!contribute(s, job, block, transmittance[block], c)) continue;
      red[block] += c.weight * s.red;
      green[block] += c.weight * s.green;
      blue[block] += c.weight * s.blue;
      alpha[block] += c.weight;
      depth[block] += c.weight * s.depth;
      transmittance[block] = c.next;
      if (any(c.stop) && finished(c.next)) open &= ~(BlockSet{1} << block);
    }
  }
  const std::size_t width = job.camera->width;
  for (int block = 0; block < kBlocks; ++block)
    for (int l = 0; l < kLanes; ++l) {
      const Pixel p = pixel_of(job, block, l);
      if (!inside(job, p)) continue;
      const std::size_t at = p.y * width + p.x;
      const float t = transmittance[block][l] < 0 ? -transmittance[block][l] : transmittance[block][l];
      image.rgb[3 * at] = red[block][l] + t * job.background[0];
      image.rgb[3 * at + 1] = green[block][l] + t * job.background[1];
      image.rgb[3 * at + 2] = blue[block][l] + t * job.background[2];
      const float a = alpha[block][l];
      image.alpha[at] = a < 1.0f ? a : 1.0f;
      image.depth[at] = a > 0.0f ? depth[block][l] / a : 0.0f;
    }
}

namespace {

struct PixelGrads {  // dL/d of what a pixel accumulates: per Gaussian it adds weight * (rgb . c + constant + depth * z)
  FloatV red[kBlocks], green[kBlocks], blue[kBlocks], depth[kBlocks], constant[kBlocks];
  FloatV behind[kBlocks];  // the pixel's total of that, less what has been passed
};

void load_pixel_grads(const TileJob& job, const Image& image, const ImageGrad& v, PixelGrads& grads) {
  std::memset(&grads, 0, sizeof grads);
  const float* background = job.background;
  const std::size_t width = job.camera->width;
  for (int block = 0; block < kBlocks; ++block)
    for (int l = 0; l < kLanes; ++l) {
      const Pixel p = pixel_of(job, block, l);
      if (!inside(job, p)) continue;
      const std::size_t at = p.y * width + p.x;
      const float alpha = image.alpha[at], *rgb = image.rgb + 3 * at, *v_rgb = v.rgb + 3 * at;
      float constant = v.alpha ? v.alpha[at] : 0.0f, depth = 0.0f;
      if (v.depth && alpha > 0) {  // depth = accumulated / alpha
        depth = v.depth[at] / alpha;
        constant -= depth * image.depth[at];
      }
      float foreground = 0.0f;  // rgb = accumulated + (1 - alpha) background
      for (int c = 0; c < 3; ++c) {
        constant -= v_rgb[c] * background[c];
        foreground += v_rgb[c] * (rgb[c] - background[c]);
      }
      foreground += constant * alpha + depth * image.depth[at] * alpha;
      for (int c = 0; c < 3; ++c) foreground += v_rgb[c] * background[c] * alpha;
      grads.red[block][l] = v_rgb[0], grads.green[block][l] = v_rgb[1], grads.blue[block][l] = v_rgb[2];
      grads.depth[block][l] = depth, grads.constant[block][l] = constant, grads.behind[block][l] = foreground;
    }
}

template <bool kDepth>
void rasterize_tile_bwd(const TileJob& job, PixelGrads& grads, const std::uint32_t* slots, SplatGrad* pair_grads) {
  FloatV transmittance[kBlocks];
  BlockSet open = open_pixels(job, transmittance);
  for (std::size_t i = 0; i < job.count; ++i) {
    const Splat& s = splat_at(job, i);
    BlockSet todo = open ? open & touched_blocks(s, job.x0, job.y0) : 0;
    FloatV v_red{}, v_green{}, v_blue{}, v_depth{}, v_s{}, v_sx{}, v_su{}, v_sxx{}, v_sxu{}, v_suu{};
    bool touched = false;
    for (; todo; todo &= todo - 1) {
      const int block = __builtin_ctzll(todo);
      Contribution c;
      if (!contribute(s, job, block, transmittance[block], c)) continue;
      touched = true;
      FloatV value = grads.red[block] * s.red + grads.green[block] * s.green + grads.blue[block] * s.blue + grads.constant[block];
      if constexpr (kDepth) value += grads.depth[block] * s.depth;
      const FloatV own = c.weight * value, behind = grads.behind[block] - own;
      // dL/d(ln alpha) = weight * value - alpha / (1 - alpha) * behind, where this one is drawn and not clamped.
      const MaskV moves = both(first_only(c.visible, c.stop), less(c.density, splat(kAlphaMax)));
      const FloatV ds = keep(moves, own - behind * (c.alpha / (1.0f - c.alpha)));
      v_red += c.weight * grads.red[block];
      v_green += c.weight * grads.green[block];
      v_blue += c.weight * grads.blue[block];
      if constexpr (kDepth) v_depth += c.weight * grads.depth[block];
      const FloatV sx = ds * c.dx, su = ds * c.u;
      v_s += ds;
      v_sx += sx;
      v_su += su;
      v_sxx += sx * c.dx;
      v_sxu += sx * c.u;
      v_suu += su * c.u;
      grads.behind[block] = behind;
      transmittance[block] = c.next;
      if (any(c.stop) && finished(c.next)) open &= ~(BlockSet{1} << block);
    }
    SplatGrad& out = pair_grads[slots[i]];
    if (!touched) {
      out = SplatGrad{};
      continue;
    }
    float sums[12];
    store4(sums, sums4(fold4(v_red), fold4(v_green), fold4(v_blue), fold4(v_depth)));
    store4(sums + 4, sums4(fold4(v_s), fold4(v_sx), fold4(v_su), fold4(v_sxx)));
    store4(sums + 8, sums4(fold4(v_sxu), fold4(v_suu), Float4{}, Float4{}));
    std::memcpy(&out, sums, sizeof out);
  }
}

}  // namespace

void rasterize_bwd(const TileJob& job, const Image& image, const ImageGrad& v, const std::uint32_t* slots, SplatGrad* pair_grads) {
  PixelGrads grads;
  load_pixel_grads(job, image, v, grads);
  if (v.depth)
    rasterize_tile_bwd<true>(job, grads, slots, pair_grads);
  else
    rasterize_tile_bwd<false>(job, grads, slots, pair_grads);
}

}  // namespace cap4d::CAP4D_ISA
